/* Errors of the structure of a chain of arcs: arcs of the whole chain -> changed arcs up to the tip.

   Loads at the robot's end twist a segment k by phi_k and move its end sideways by s_k. With its
   strain e, the torque vectors t = a x d (tangent a, lever d to the end) and the transverse axes x
   and y of the frames before and after it, and its constant vectors w and v:

       phi_k = (1 + e) w . (t_before + t_after)          angle_k = phi_0 + ... + phi_k / 2
       s_k   = (1 + 2 e) (v . (x_before + x_after), v . (y_before + y_after))

   The bending b becomes b + angle_k J b + s_k - s_(k-1), and a constant linear map of (e, b) is added
   to length and bending. */

/* Numbers of a segment: strain by length and of no length, its rigid offset, the constant changes of
   length and bending, the rows of the linear map, w and v. The part of it up to the tip comes last. */
#define HK_NO_LENGTH 1
#define HK_OFFSET 2
#define HK_CHANGE 3
#define HK_MAP 6
#define HK_TWIST 15
#define HK_SAG 18
#define HK_PART 21
#define HK_STRUCTURE 22

typedef struct {
    int S, tip; /* segments, and up to the tip */
    const real *segments;
} HK(structure);

/* What the derivative of a row needs. Frame k + 1 is that after segment k. */
typedef struct {
    V *arcs;           /* of the whole chain (3 S) */
    HK(posed) *frames; /* (S + 1) */
    V *angle, *twist;  /* (S); of the twist without its factor 1 + e */
    V *sag;            /* (S, 2), without its factor 1 + 2 e */
    V *moves, *spins;  /* motion of the end, and angular velocity, by the arcs of a segment (S, 9) */
    V *forces;         /* on twist and sags of a segment (S, 3) */
    V *pulls, *turns;  /* on the end, and on the frame after a segment (S, 3) */
    V *by_arcs;        /* derivatives by the arcs of the whole chain, of up to 6 rows (6, 3 S) */
} HK(loaded);

#define HK_LOADED_WORK(S)                                                                          \
    (HK_USES(HK_STRUCTURAL) * (3 * (S) + 51 * ((S) + 1) + 4 * (S) + 18 * (S) + 9 * (S) + 18 * (S)))

static inline HK(structure) HK(structure_of)(const hk_plan *p, int at) {
    const int32_t *more = p->code + at + HK_MORE;
    HK(structure) s = {more[2], more[0], hk_numbers(p, at) + HK_FRAME + more[0]};
    return s;
}

static inline HK(loaded) HK(loaded_of)(int S, V **work) {
    HK(loaded) a;
    a.arcs = HK(take)(work, 3 * S);
    a.frames = (HK(posed) *)HK(take)(work, HK_POSED * (S + 1));
    a.angle = HK(take)(work, S);
    a.twist = HK(take)(work, S);
    a.sag = HK(take)(work, 2 * S);
    a.moves = HK(take)(work, 9 * S);
    a.spins = HK(take)(work, 9 * S);
    a.forces = HK(take)(work, 3 * S);
    a.pulls = HK(take)(work, 3 * S);
    a.turns = HK(take)(work, 3 * S);
    a.by_arcs = HK(take)(work, 18 * S);
    return a;
}

#define HK_TORQUE 5 /* among the vectors of a frame, after its axes */

/* w . (a + b) */
static inline V HK(along)(const real *w, const V *a, const V *b) {
    return (a[0] + b[0]) * w[0] + (a[1] + b[1]) * w[1] + (a[2] + b[2]) * w[2];
}

/* The strain of segment k. */
static inline V HK(strain)(const real *own, V length) {
    return length * own[0] - own[HK_NO_LENGTH];
}

/* The frames of the arcs, in that of the base, with the torque vectors of a load at the end. */
HK_INLINE void HK(load_frames)(HK(structure) s, const HK(loaded) * a) {
    V axes[3][3], end[3] = {SPLAT(0.0), SPLAT(0.0), SPLAT(0.0)};
    for (int i = 0; i < 9; i++) axes[i / 3][i % 3] = SPLAT(i % 4 == 0 ? 1.0 : 0.0);
    for (int k = 0; k <= s.S; k++) {
        HK(posed) *frame = a->frames + k;
        if (k)
            HK(follow)(a->arcs[k - 1], a->arcs[s.S + k - 1], a->arcs[2 * s.S + k - 1],
                       s.segments[HK_STRUCTURE * (k - 1) + HK_OFFSET], axes, end, frame);
        for (int i = 0; i < 3; i++) {
            frame->end[i] = end[i];
            for (int axis = 0; axis < 3; axis++) frame->vectors[axis][i] = axes[axis][i];
        }
    }
    for (int k = 0; k <= s.S; k++) {
        HK(posed) *frame = a->frames + k;
        const V lever[3] = {end[0] - frame->end[0], end[1] - frame->end[1],
                            end[2] - frame->end[2]};
        HK(cross)(frame->vectors[2], lever, frame->vectors[HK_TORQUE]);
    }
}

/* The changed arcs z (3 tip) up to the tip. */
HK_INLINE void HK(change_arcs)(HK(structure) s, const HK(loaded) * a, V *z) {
    V twisted = SPLAT(0.0), behind[2] = {SPLAT(0.0), SPLAT(0.0)};
    HK(load_frames)(s, a);
    for (int k = 0; k < s.tip; k++) {
        const real *own = s.segments + HK_STRUCTURE * k, *map = own + HK_MAP;
        const HK(posed) *before = a->frames + k, *after = before + 1;
        const V arc[3] = {a->arcs[k], a->arcs[s.S + k], a->arcs[2 * s.S + k]};
        const V e = HK(strain)(own, arc[0]);
        a->twist[k] =
            HK(along)(own + HK_TWIST, before->vectors[HK_TORQUE], after->vectors[HK_TORQUE]);
        const V twist = (R(1.0) + e) * a->twist[k], angle = twisted + R(0.5) * twist;
        twisted = twisted + twist;
        a->angle[k] = angle;
        V moved[3] = {SPLAT(0.0), -(angle * arc[2]), angle * arc[1]};
        for (int i = 0; i < 2; i++) {
            V *sag = a->sag + 2 * k + i;
            *sag = HK(along)(own + HK_SAG, before->vectors[i], after->vectors[i]);
            const V here = (R(1.0) + e + e) * *sag;
            moved[1 + i] = moved[1 + i] + (here - behind[i]);
            behind[i] = here;
        }
        for (int i = 0; i < 3; i++) {
            const V linear = e * map[3 * i] + arc[1] * map[3 * i + 1] + arc[2] * map[3 * i + 2];
            z[i * s.tip + k] = (arc[i] + (moved[i] + linear + own[HK_CHANGE + i])) * own[HK_PART];
        }
    }
}

/* How the arcs of every segment move and turn the robot's end, in the frame of the base. */
HK_INLINE void HK(motions_of_end)(HK(structure) s, const HK(loaded) * a) {
    const V *end = a->frames[s.S].end;
    for (int k = 0; k < s.S; k++) {
        const HK(posed) *frame = a->frames + k + 1;
        const V lever[3] = {end[0] - frame->arc_end[0], end[1] - frame->arc_end[1],
                            end[2] - frame->arc_end[2]};
        for (int part = 0; part < 3; part++) {
            V *move = a->moves + 9 * k + 3 * part, *spin = a->spins + 9 * k + 3 * part, turned[3];
            const V *m = frame->moves[part], *w = frame->spins[part];
            for (int i = 0; i < 3; i++) {
                const V x = frame->before[i], y = frame->before[3 + i], t = frame->before[6 + i];
                move[i] = x * m[0] + y * m[1] + t * m[2];
                spin[i] = x * w[0] + y * w[1] + t * w[2];
            }
            if (part == 0) continue; /* a length turns nothing */
            HK(cross)(spin, lever, turned);
            for (int i = 0; i < 3; i++) move[i] = move[i] + turned[i];
        }
    }
}

/* c (3) += a x b */
static inline void HK(add_cross)(const V *a, const V *b, V *c) {
    for (int i = 0; i < 3; i++)
        c[i] = c[i] + (a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3]);
}

/* The forces of the loads that act on twist and sags: what they pull the end by, and how they turn
   the frames. The frame of the base does not turn. */
HK_INLINE void HK(spread_forces)(HK(structure) s, const HK(loaded) * a) {
    V pull[3] = {SPLAT(0.0), SPLAT(0.0), SPLAT(0.0)};
    for (int k = 0; k <= s.S; k++) {
        const HK(posed) *frame = a->frames + k;
        const real *before = s.segments + HK_STRUCTURE * (k - 1), *after = before + HK_STRUCTURE;
        V on[3][3]; /* on torque, x-axis and y-axis */
        for (int v = 0; v < 3; v++)
            for (int i = 0; i < 3; i++) {
                const int at = (v ? HK_SAG : HK_TWIST) + i;
                on[v][i] = SPLAT(0.0);
                if (k && k <= s.tip) on[v][i] = a->forces[3 * k - 3 + v] * before[at];
                if (k < s.tip) on[v][i] = on[v][i] + a->forces[3 * k + v] * after[at];
            }
        if (k) {
            V *turn = a->turns + 3 * k - 3;
            HK(cross)(frame->vectors[HK_TORQUE], on[0], turn);
            HK(add_cross)(frame->vectors[0], on[1], turn);
            HK(add_cross)(frame->vectors[1], on[2], turn);
        }
        if (k == s.S) break;
        HK(add_cross)(on[0], frame->vectors[2], pull);
        for (int i = 0; i < 3; i++) a->pulls[3 * k + i] = pull[i];
    }
}

/* by_arcs (rows, 3 S) = C D, for the derivative D (3 tip, 3 S) of `change_arcs` and C (rows, 3 tip):
   by virtual work, one row at a time. */
HK_INLINE void HK(pull_change)(HK(structure) s, const HK(loaded) * a, int rows, const V *C) {
    V *by_arcs = a->by_arcs;
    HK(motions_of_end)(s, a);
    for (int row = 0; row < rows; row++, C += 3 * s.tip, by_arcs += 3 * s.S) {
        V later = SPLAT(0.0), next[2] = {SPLAT(0.0), SPLAT(0.0)};
        for (int k = s.S - 1; k >= 0; k--) {
            const real *own = s.segments + HK_STRUCTURE * k, *map = own + HK_MAP;
            for (int i = 0; i < 3; i++) by_arcs[i * s.S + k] = SPLAT(0.0);
            if (k >= s.tip) continue;
            const V c[3] = {C[k] * own[HK_PART], C[s.tip + k] * own[HK_PART],
                            C[2 * s.tip + k] * own[HK_PART]};
            const V e = HK(strain)(own, a->arcs[k]), angle = a->angle[k];
            const V on_angle = c[2] * a->arcs[s.S + k] - c[1] * a->arcs[2 * s.S + k];
            const V on_twist = later + R(0.5) * on_angle;
            const V on_x = c[1] - next[0], on_y = c[2] - next[1];
            later = later + on_angle;
            next[0] = c[1];
            next[1] = c[2];
            a->forces[3 * k] = (R(1.0) + e) * on_twist;
            a->forces[3 * k + 1] = (R(1.0) + e + e) * on_x;
            a->forces[3 * k + 2] = (R(1.0) + e + e) * on_y;
            V on[3];
            for (int j = 0; j < 3; j++)
                on[j] = c[0] * map[j] + c[1] * map[3 + j] + c[2] * map[6 + j];
            const V sags = on_x * a->sag[2 * k] + on_y * a->sag[2 * k + 1];
            const V on_strain = on[0] + on_twist * a->twist[k] + (sags + sags);
            by_arcs[k] = c[0] + on_strain * own[0];
            by_arcs[s.S + k] = c[1] + on[1] + c[2] * angle;
            by_arcs[2 * s.S + k] = c[2] + on[2] - c[1] * angle;
        }
        HK(spread_forces)(s, a);
        V turn[3] = {SPLAT(0.0), SPLAT(0.0), SPLAT(0.0)};
        for (int k = s.S - 1; k >= 0; k--) {
            const V *pull = a->pulls + 3 * k;
            for (int i = 0; i < 3; i++) turn[i] = turn[i] + a->turns[3 * k + i];
            for (int part = 0; part < 3; part++) {
                const V *move = a->moves + 9 * k + 3 * part, *spin = a->spins + 9 * k + 3 * part;
                V *sum = by_arcs + part * s.S + k;
                *sum = *sum + (pull[0] * move[0] + pull[1] * move[1] + pull[2] * move[2]);
                if (part)
                    *sum = *sum + (turn[0] * spin[0] + turn[1] * spin[1] + turn[2] * spin[2]);
            }
        }
    }
}
