/* How readings of the tip are used: an offset between robot and model, in the rows of the task, which
   each of them changes. A reading is compared with the model's tip of its own time, from a ring of
   the last ones. One that cannot be is not used; consecutive ones that agree are believed. */

/* Numbers of this state. */
#define IK_SEEN_SIZE(m, width) (IK_DOUBTS + IK_AGREEING * (m) + IK_RING * (1 + (width)))

/* The row of the ring `back` periods ago: the time since the tip before, and the tip. */
static inline real *ik_past(const ik_settings *ik, real *seen, int back) {
    const int row = ((int)seen[IK_NEWEST] - back + IK_RING) % IK_RING;
    return seen + IK_DOUBTS + IK_AGREEING * ik->m + row * (1 + ik->width);
}

/* Remember the present tip of the model x. */
static inline void ik_record(const ik_settings *ik, real *seen, const real *x) {
    const int next = (int)seen[IK_NEWEST] + 1;
    seen[IK_NEWEST] = (real)(next < IK_RING ? next : 0);
    if (seen[IK_FILLED] < (real)IK_RING) seen[IK_FILLED] += R(1.0);
    real *row = ik_past(ik, seen, 0);
    row[0] = seen[IK_SINCE];
    for (int i = 0; i < ik->width; i++) row[1 + i] = x[i];
}

/* The size of rows (m) of the task: 1 for what is expected. */
static inline real ik_size(const ik_settings *ik, const real *rows) {
    real scaled[IK_ROWS];
    for (int i = 0; i < ik->m; i++) scaled[i] = rows[i] / ik->expected[i];
    return ik_norm(ik->m, scaled);
}

/* shown (m) = a tip minus that of the model at its time, linear between two; NaN if unknown. */
static inline void ik_shown(const ik_settings *ik, real *seen, const real *tip, real *shown) {
    const int oldest = (int)seen[IK_FILLED] - 1;
    real left = seen[IK_AGE], before[IK_ROWS];
    int back = 0;
    for (; back < oldest && left > *ik_past(ik, seen, back); back++)
        left -= *ik_past(ik, seen, back);
    const real *row = ik_past(ik, seen, back);
    ik_difference(ik, row + 1, tip, shown);
    if (left >= R(0.0) && left <= IK_ON_TIME * row[0]) return;
    const int known = left >= R(0.0) && back < oldest;
    if (known) ik_difference(ik, ik_past(ik, seen, back + 1) + 1, tip, before);
    for (int i = 0; i < ik->m; i++)
        shown[i] = known ? shown[i] + left / row[0] * (before[i] - shown[i]) : R(NAN);
}

/* The size of the motion of the model's tip in the last periods: a reading may be late by so much
   without anybody knowing. */
static inline real ik_recent_motion(const ik_settings *ik, real *seen) {
    const real *now = ik_past(ik, seen, 0) + 1;
    real most = R(0.0), moved[IK_ROWS];
    for (int back = 1; back <= IK_RECENT && back < (int)seen[IK_FILLED]; back++) {
        ik_difference(ik, ik_past(ik, seen, back) + 1, now, moved);
        const real size = ik_size(ik, moved);
        if (size > most && size < R(INFINITY)) most = size;
    }
    return most;
}

/* The middle one of the doubted offsets, row by row. */
static inline void ik_middle(int m, const real *doubted, real *middle) {
    for (int i = 0; i < m; i++)
        for (int k = 0; k < IK_AGREEING; k++) {
            int smaller = 0;
            for (int l = 0; l < IK_AGREEING; l++) {
                const real a = doubted[l * m + i], b = doubted[k * m + i];
                smaller += a < b || (a == b && l < k);
            }
            if (smaller == IK_AGREEING / 2) middle[i] = doubted[k * m + i];
        }
}

/* Doubt an offset (m), and return 1 if as many as are needed agree: then it is their middle one. */
static inline int ik_doubt(const ik_settings *ik, real *seen, const real *doubt, real bound,
                           real *offset) {
    const int m = ik->m;
    real *doubted = seen + IK_DOUBTS, middle[IK_ROWS], off[IK_ROWS];
    for (int i = (IK_AGREEING - 1) * m - 1; i >= 0; i--) doubted[m + i] = doubted[i];
    for (int i = 0; i < m; i++) doubted[i] = doubt[i];
    if (seen[IK_DOUBTED] < (real)IK_AGREEING) seen[IK_DOUBTED] += R(1.0);
    if (seen[IK_DOUBTED] < (real)IK_AGREEING) return 0;
    ik_middle(m, doubted, middle);
    for (int k = 0; k < IK_AGREEING; k++) {
        for (int i = 0; i < m; i++) off[i] = doubted[k * m + i] - middle[i];
        if (!(ik_size(ik, off) <= bound)) return 0;
    }
    for (int i = 0; i < m; i++) offset[i] = middle[i];
    return 1;
}

/* Move the offset (m) towards what a reading shows, where it is known, and return 1; else 0. */
static inline int ik_accept(const ik_settings *ik, real *seen, const real *shown, const int *known,
                            real *offset) {
    const int m = ik->m;
    real innovation[IK_ROWS], doubt[IK_ROWS], whole[IK_ROWS];
    const real bound = R(1.0) + ik_recent_motion(ik, seen), most = R(1.0) / ik->fraction;
    for (int i = 0; i < m; i++) {
        doubt[i] = known[i] ? shown[i] : offset[i];
        whole[i] = known[i] ? shown[i] : R(0.0);
        innovation[i] = doubt[i] - offset[i];
    }
    if (ik_size(ik, innovation) <= bound) {
        /* The first ones count alike, as there was no offset before. */
        const real weight = seen[IK_WEIGHT] + R(1.0);
        seen[IK_WEIGHT] = weight < most ? weight : most;
        const real fraction = R(1.0) / seen[IK_WEIGHT];
        for (int i = 0; i < m; i++)
            if (known[i]) offset[i] = (R(1.0) - fraction) * offset[i] + fraction * shown[i];
    } else {
        if (!(ik_size(ik, whole) <= ik->most)) return 0;
        if (!ik_doubt(ik, seen, doubt, bound, offset)) return 0;
        seen[IK_WEIGHT] = most; /* the robot has moved, or is another one than the model */
    }
    seen[IK_DOUBTED] = R(0.0);
    return 1;
}

/* Take a reading of the tip, as old as the state says, and return whether it is used. shown (m) = the
   offset that it shows, NaN if it is not known. */
static HK_NOINLINE int ik_read(const ik_settings *ik, real *seen, const real *tip, real *offset,
                               real *shown) {
    int known[IK_ROWS], count = 0, used = 0;
    ik_shown(ik, seen, tip, shown);
    for (int i = 0; i < ik->m; i++) count += known[i] = ik_finite(1, shown + i);
    if (count) used = ik_accept(ik, seen, shown, known, offset);
    seen[IK_REJECTED] = (real)(count && !used);
    for (int i = 0; i < ik->m; i++)
        if (count && !known[i]) shown[i] = offset[i];
    return used;
}

/* Change the offset (m) by a reading of the tip, or none (NULL): then, or where the reading is not
   used, it decays with the time constant `memory`. shown (m): see above, without one the offset. */
static inline void ik_hear(const ik_settings *ik, real *seen, const real *tip, real memory,
                           real *offset, real *shown) {
    seen[IK_REJECTED] = R(0.0);
    if (!(tip && ik_read(ik, seen, tip, offset, shown)) && memory < R(INFINITY)) {
        const real kept = HK_MATH(exp)(-*ik_past(ik, seen, 0) / memory);
        seen[IK_WEIGHT] *= kept;
        for (int i = 0; i < ik->m; i++) offset[i] *= kept;
    }
    for (int i = 0; i < ik->m && !tip; i++) shown[i] = offset[i];
}
