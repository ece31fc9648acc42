/* The body keeps clear of obstacles, and of itself. A pair is a point of the body and an obstacle, or
   two points that can meet; its gap is what is left between them. Gaps give rows of a step to first
   order, and where a step ends, all of them are looked at again. */

/* The distance of a point x (3) to an obstacle, negative inside, and the direction (3) out of it. */
static inline real ik_obstacle(const real *obstacle, const real *x, real *normal) {
    const real *axes = obstacle + 3, *low = obstacle + 12, *high = obstacle + 15;
    real place[3], way[3], square = R(0.0), distance;
    for (int i = 0; i < 3; i++) {
        place[i] = R(0.0);
        for (int j = 0; j < 3; j++) place[i] += axes[3 * i + j] * (x[j] - obstacle[j]);
        way[i] = place[i] - ik_clip(place[i], low[i], high[i]);
        square += way[i] * way[i];
    }
    if (square > R(0.0)) {
        distance = HK_MATH(sqrt)(square);
        for (int i = 0; i < 3; i++) way[i] /= distance;
    } else { /* inside, the nearest side is the way out */
        real depth = R(INFINITY);
        int side = 0;
        for (int i = 0; i < 3; i++) {
            const real below = place[i] - low[i], above = high[i] - place[i];
            const real least = above < below ? above : below;
            way[i] = above < below ? R(1.0) : R(-1.0);
            if (!(least >= depth)) depth = least, side = i;
        }
        for (int i = 0; i < 3; i++) way[i] = i == side ? way[i] : R(0.0);
        distance = -depth;
    }
    for (int j = 0; j < 3; j++)
        normal[j] = axes[j] * way[0] + axes[3 + j] * way[1] + axes[6 + j] * way[2];
    return distance - obstacle[18];
}

/* What is near the body at a configuration, in the memory of the caller. */
typedef struct {
    int n_points, n_pairs, count; /* count: rows of the step */
    int chosen[IK_PAIRS_MOST];    /* their pairs */
    real rounding;                /* of places */
    real *x, *J;                  /* points (3) of the body, and their derivatives (3, n) */
    real *moved;                  /* ways (3) of the points */
    real *reach;                  /* the farthest ways (3) to first order */
    real *gap, *normal;           /* of pairs, and the directions (3) in which gaps grow */
    real *tight, *taken;          /* limits of pairs that a step broke, and what it takes of gaps */
} ik_near_t;

static inline ik_near_t ik_near_of(const ik_settings *ik) {
    const int n_points = ik->body[IK_N_POINTS];
    ik_near_t near = {.n_points = n_points, .n_pairs = IK_PAIRS_OF(ik->body, ik->n_obstacles)};
    near.x = ik_near_memory(ik);
    near.J = near.x + 3 * n_points;
    near.moved = near.J + 3 * n_points * ik->n;
    near.reach = near.moved + 3 * n_points;
    near.gap = near.reach + 3 * n_points;
    near.normal = near.gap + near.n_pairs;
    near.tight = near.normal + 3 * near.n_pairs;
    near.taken = near.tight + near.n_pairs;
    return near;
}

/* The first and the second point of a pair; the first one is -1 for an obstacle. */
static inline void ik_pair(const ik_settings *ik, int pair, int *one, int *other) {
    const int n_points = ik->body[IK_N_POINTS], n_meeting = ik->body[IK_N_MEETING];
    const int of_two = pair - n_points * ik->n_obstacles;
    const int32_t *meeting = ik->body + IK_POINTS + n_points;
    *one = of_two < 0 ? -1 : meeting[of_two];
    *other = of_two < 0 ? pair / ik->n_obstacles : meeting[n_meeting + of_two];
}

/* The points of the body at q: places x (3) and where not NULL their derivatives J (3, n). The last
   one, the tip, may be `known`. */
static HK_NOINLINE void ik_points(const ik_settings *ik, int known, const real *q, real *x, real *J) {
    for (int i = 0; i < ik->body[IK_N_POINTS] - known; i++)
        hk_model(&ik->plan, ik->body[IK_POINTS + i], q, x + 3 * i, J ? J + 3 * ik->n * i : NULL,
                 NULL, ik->work);
}

/* Whether the task is the place of the tip, in its own unit, and steps keep to no plane. */
static inline int ik_is_tip(const ik_settings *ik) {
    const int last = ik->body[IK_POINTS + ik->body[IK_N_POINTS] - 1];
    int is = ik->m == 3 && ik->n_normals == 0 && last == ik->model;
    for (int i = 0; is && i < 3; i++) is = ik->scale[i] == R(1.0);
    return is;
}

/* The gaps at q, where the task has x and J. */
static HK_NOINLINE void ik_find_gaps(const ik_settings *ik, const real *q, const real *x,
                                     const real *J, ik_near_t *near) {
    const int n = ik->n, n_points = near->n_points, n_meeting = ik->body[IK_N_MEETING];
    const int known = ik_is_tip(ik), last = n_points - 1;
    const int32_t *meeting = ik->body + IK_POINTS + n_points;
    const real *along = ik->keep + n_points + n_meeting, *base = along + n_points;
    real *gap = near->gap, *normal = near->normal, largest = R(0.0);
    ik_points(ik, known, q, near->x, near->J);
    for (int i = 0; known && i < 3; i++) near->x[3 * last + i] = x[i];
    for (int i = 0; known && i < 3 * n; i++) near->J[3 * n * last + i] = J[i];
    for (int i = 0; i < 3 * n_points; i++) largest = hk_larger(ik_abs(near->x[i]), largest);
    near->rounding = R(32.0) * HK_EPS * largest;
    for (int k = 0; k < ik->n_obstacles; k++) {
        const real *obstacle = ik->scene + IK_OBSTACLE * k;
        real aside[3];
        const real at_base = ik_obstacle(obstacle, base, aside);
        for (int i = 0; i < n_points; i++) {
            const int pair = ik->n_obstacles * i + k;
            gap[pair] = ik_obstacle(obstacle, near->x + 3 * i, normal + 3 * pair) - ik->keep[i];
            /* No configuration is free: the robot is mounted there. */
            if (ik->keep[i] - along[i] > at_base) gap[pair] = R(INFINITY);
        }
    }
    gap += n_points * ik->n_obstacles, normal += 3 * n_points * ik->n_obstacles;
    for (int k = 0; k < n_meeting; k++, gap++, normal += 3) {
        const real *one = near->x + 3 * meeting[k], *other = near->x + 3 * meeting[n_meeting + k];
        for (int i = 0; i < 3; i++) normal[i] = other[i] - one[i];
        const real size = ik_norm(3, normal);
        for (int i = 0; size > R(0.0) && i < 3; i++) normal[i] /= size;
        *gap = size - ik->keep[n_points + k];
    }
    for (int p = 0; p < near->n_pairs; p++) near->tight[p] = R(INFINITY);
}

/* What a step of one takes of the gap of a pair, to first order, by every actuator (n). */
static inline void ik_gap_row(const ik_settings *ik, const ik_near_t *near, int pair, real *row) {
    const int n = ik->n;
    const real *normal = near->normal + 3 * pair;
    int one, other;
    ik_pair(ik, pair, &one, &other);
    const real *to = near->J + 3 * n * other, *from = near->J + 3 * n * (one < 0 ? 0 : one);
    for (int j = 0; j < n; j++)
        row[j] = -(normal[0] * to[j] + normal[1] * to[n + j] + normal[2] * to[2 * n + j]);
    for (int j = 0; one >= 0 && j < n; j++)
        row[j] += normal[0] * from[j] + normal[1] * from[n + j] + normal[2] * from[2 * n + j];
}

/* How much of the gap of a pair a step may take: less than all, and so little that it can stop. */
static inline real ik_gap_limit(const ik_settings *ik, const ik_near_t *near, int pair,
                                real seconds) {
    const real gap = near->gap[pair], part = IK_NEARER * gap;
    real row[HK_MAX_N], brake = R(0.0);
    if (!(ik->flags & IK_ACCELERATES && gap > R(0.0))) return part;
    ik_gap_row(ik, near, pair, row);
    for (int j = 0; j < ik->n; j++)
        if (row[j] != R(0.0)) brake += ik_abs(row[j]) * ik->accel[j] * seconds * seconds;
    const real stops = ik_stopping(gap, brake);
    return stops < part ? stops : part;
}

/* Choose the pairs of the smallest gaps, after those that a step broke. */
static inline void ik_choose_nearest(ik_near_t *near) {
    real keys[IK_PAIRS_MOST];
    near->count = 0;
    if (near->n_pairs <= IK_PAIRS_MOST) {
        for (; near->count < near->n_pairs; near->count++) near->chosen[near->count] = near->count;
        return;
    }
    for (int p = 0; p < near->n_pairs; p++) {
        const int broken = near->tight[p] < R(INFINITY), known = near->gap[p] == near->gap[p];
        const real key = broken ? -R(INFINITY) : known ? near->gap[p] : R(INFINITY);
        int at = near->count;
        if (at == IK_PAIRS_MOST && !(key < keys[at - 1])) continue;
        if (at < IK_PAIRS_MOST) near->count++;
        else at--;
        for (; at > 0 && key < keys[at - 1]; at--) {
            keys[at] = keys[at - 1];
            near->chosen[at] = near->chosen[at - 1];
        }
        keys[at] = key, near->chosen[at] = p;
    }
}

/* The farthest ways of the points to first order, in every coordinate, by steps within bounds. */
static inline void ik_reaches(const ik_settings *ik, const ik_step_t *s, ik_near_t *near) {
    real most[HK_MAX_N];
    for (int j = 0; j < ik->n; j++) most[j] = hk_larger(-s->lower[j], s->upper[j]);
    for (int i = 0; i < 3 * near->n_points; i++) {
        const real *row = near->J + ik->n * i;
        real sum = R(0.0);
        for (int j = 0; j < ik->n; j++) sum += ik_abs(row[j]) * most[j];
        near->reach[i] = sum;
    }
}

/* Whether steps within their bounds leave a pair its limit b for certain. */
static inline int ik_is_far(const ik_settings *ik, const ik_near_t *near, int pair, real b) {
    const real *normal = near->normal + 3 * pair;
    int one, other;
    real way = R(0.0);
    ik_pair(ik, pair, &one, &other);
    for (int i = 0; i < 3; i++) {
        way += ik_abs(normal[i]) * near->reach[3 * other + i];
        if (one >= 0) way += ik_abs(normal[i]) * near->reach[3 * one + i];
    }
    return way < b || b == R(INFINITY);
}

/* Write rows A (k, n) and limits b (k) of the pairs that are near, the nearest first, in the unit in
   which weights are 1; return k. */
static HK_NOINLINE int ik_gap_rows(const ik_settings *ik, ik_near_t *near, real seconds, real *A,
                                   real *b) {
    const int n = ik->n;
    int k = 0;
    ik_choose_nearest(near);
    for (int i = 0; i < near->count; i++) {
        const int pair = near->chosen[i];
        const real gap = near->gap[pair], limit = ik_gap_limit(ik, near, pair, seconds);
        const real allowed = near->tight[pair] < limit ? near->tight[pair] : limit;
        if (ik_is_far(ik, near, pair, allowed)) continue;
        int at = k++;
        for (; at > 0 && gap < near->gap[near->chosen[at - 1]]; at--) {
            near->chosen[at] = near->chosen[at - 1];
            b[at] = b[at - 1];
        }
        near->chosen[at] = pair, b[at] = allowed;
    }
    for (int i = 0; i < k; i++, A += n) {
        ik_gap_row(ik, near, near->chosen[i], A);
        for (int j = 0; ik->flags & IK_WEIGHTS && j < n; j++) A[j] *= ik->unit[j];
    }
    return k;
}

/* Whether a step is at a limit of the rows from `first` on. */
static inline int ik_meets(const ik_settings *ik, const ik_rows_t *rows, int first, const real *dq) {
    for (int i = first; i < rows->k; i++) {
        real left = rows->b[i], size = ik_abs(rows->b[i]);
        for (int j = 0; j < ik->n; j++) {
            const real own = ik->flags & IK_WEIGHTS ? dq[j] / ik->unit[j] : dq[j];
            const real part = rows->A[ik->n * i + j] * own;
            left -= part, size += ik_abs(part);
        }
        if (left <= R(64.0) * HK_EPS * size) return 1;
    }
    return 0;
}

/* The way of an actuator after a step, until it stands or in some periods: every step is shorter by
   `change`. */
static inline real ik_way_to_stop(real step, real change, real periods) {
    const real size = ik_abs(step), whole = HK_MATH(floor)(size / change);
    const real count = whole < periods ? whole : periods;
    if (!(count >= R(1.0) && count < R(INFINITY))) return R(0.0);
    const real way = count * size - R(0.5) * count * (count + R(1.0)) * change;
    return step < R(0.0) ? -way : way;
}

/* Whether a pair loses more than its gap, or is not known. */
static inline int ik_is_broken(const ik_near_t *near, int pair) {
    const real gap = near->gap[pair], left = gap < R(0.0) ? R(0.0) : gap;
    return !(near->taken[pair] <= left + near->rounding);
}

/* Evaluate what a way from q really takes of all gaps, and return whether that is too much of any. */
static HK_NOINLINE int ik_take_gaps(const ik_settings *ik, const real *q, const real *way,
                                    ik_near_t *near) {
    const int n_points = near->n_points, n_meeting = ik->body[IK_N_MEETING];
    const int32_t *meeting = ik->body + IK_POINTS + n_points;
    real at[HK_MAX_N], *taken = near->taken;
    const real *normal = near->normal;
    int any = 0;
    for (int j = 0; j < ik->n; j++) at[j] = q[j] + way[j];
    ik_points(ik, 0, at, near->moved, NULL);
    for (int i = 0; i < 3 * n_points; i++) near->moved[i] -= near->x[i];
    for (int i = 0; i < n_points; i++)
        for (int k = 0; k < ik->n_obstacles; k++, normal += 3) {
            const real *moved = near->moved + 3 * i;
            *taken++ = -(normal[0] * moved[0] + normal[1] * moved[1] + normal[2] * moved[2]);
        }
    for (int k = 0; k < n_meeting; k++, normal += 3) {
        const real *one = near->moved + 3 * meeting[k];
        const real *other = near->moved + 3 * meeting[n_meeting + k];
        real sum = R(0.0);
        for (int i = 0; i < 3; i++) sum -= normal[i] * (other[i] - one[i]);
        *taken++ = sum;
    }
    for (int p = 0; p < near->n_pairs; p++) any |= ik_is_broken(near, p);
    return any;
}

/* The gaps as they were found, and the rounding of places. */
static inline ik_near_t ik_near_again(const ik_settings *ik) {
    ik_near_t near = ik_near_of(ik);
    real largest = R(0.0);
    for (int i = 0; i < 3 * near.n_points; i++) largest = hk_larger(ik_abs(near.x[i]), largest);
    near.rounding = R(32.0) * HK_EPS * largest;
    return near;
}

/* Whether the gap of a pair is not far larger than a way (n). */
static HK_NOINLINE int ik_passes_near(const ik_settings *ik, const real *way,
                                      const ik_near_t *near) {
    real row[HK_MAX_N];
    for (int p = 0; p < near->n_pairs; p++) {
        real longest = R(0.0);
        ik_gap_row(ik, near, p, row);
        for (int j = 0; j < ik->n; j++) longest += ik_abs(row[j]) * ik_abs(way[j]);
        if (!(R(2.0) * longest < near->gap[p])) return 1;
    }
    return 0;
}

/* After how many periods a way to a stop is looked at next: 1, ..., 16, then an eighth more. */
static inline real ik_next_place(real periods) {
    const real eighth = HK_MATH(floor)(periods / R(8.0));
    return periods + (eighth > R(1.0) ? eighth : R(1.0));
}

/* Whether a step leads too far, on the way (n) to a stop. Where this passes near something it is bent:
   then also the step alone, and parts of the way. `way` is the first one that does. */
static int ik_leads_too_far(const ik_settings *ik, const real *q, const real *dq, real seconds,
                            ik_near_t *near, real *way) {
    const int stops = ik->flags & IK_ACCELERATES;
    real most = R(0.0);
    for (int j = 0; j < ik->n; j++) {
        const real change = ik->accel[j] * seconds * seconds;
        way[j] = dq[j];
        if (!stops) continue;
        way[j] += ik_way_to_stop(dq[j], change, R(INFINITY));
        most = hk_larger(HK_MATH(floor)(ik_abs(dq[j]) / change), most);
    }
    if (ik_take_gaps(ik, q, way, near)) return 1;
    if (!(most > R(0.0) && ik_passes_near(ik, way, near))) return 0;
    real periods = R(0.0);
    for (int k = 0; periods < most && k <= IK_BRAKED; k++) {
        for (int j = 0; j < ik->n; j++)
            way[j] = dq[j] + ik_way_to_stop(dq[j], ik->accel[j] * seconds * seconds, periods);
        if (ik_take_gaps(ik, q, way, near)) return 1;
        periods = ik_next_place(periods);
    }
    return 0;
}

/* Tighten the limits of pairs of which a step dq on its way took too much, and return which part of
   it to try. What the curvature of the model took is to be at most IK_BENT_WAY of the way; it shrinks
   with the square of the step. */
static inline real ik_tighten(const ik_settings *ik, const real *dq, const real *way, real seconds,
                              ik_near_t *near) {
    const int n = ik->n;
    const real size = ik_norm(n, way);
    real row[HK_MAX_N], part = R(1.0);
    for (int p = 0; p < near->n_pairs; p++) {
        if (!ik_is_broken(near, p)) continue;
        real bent = near->taken[p];
        ik_gap_row(ik, near, p, row);
        for (int j = 0; j < n; j++) bent -= row[j] * way[j];
        const real most = IK_BENT_WAY * (ik_norm(n, row) * size);
        if (bent > R(0.0) && most / bent < part) part = most / bent;
    }
    for (int p = 0; p < near->n_pairs; p++) {
        if (!ik_is_broken(near, p)) continue;
        real beyond = near->taken[p];
        ik_gap_row(ik, near, p, row);
        for (int j = 0; j < n; j++) beyond -= row[j] * dq[j];
        const real less = IK_NEARER * hk_larger(near->gap[p], R(0.0)) - beyond * (part * part);
        if (less < ik_gap_limit(ik, near, p, seconds) && less < near->tight[p])
            near->tight[p] = less;
    }
    return part;
}

/* Whether no gap is negative. */
static inline int ik_is_free(const ik_near_t *near) {
    for (int p = 0; p < near->n_pairs; p++)
        if (!(near->gap[p] >= R(0.0))) return 0;
    return 1;
}

static inline real ik_dot(int n, const real *a, const real *b) {
    real sum = R(0.0);
    for (int i = 0; i < n; i++) sum += a[i] * b[i];
    return sum;
}

/* The step after which the body is clear of obstacles, and can stop before them. Where the model bends
   its way into one, rows are tightened by what it took too much, and a part of the wish is tried;
   where that does not help, the step is shortened towards the hardest braking. `rows` holds those of
   other limits. */
static HK_NOINLINE void ik_step_clear(const ik_settings *ik, const ik_wish_t *wish, const real *J,
                                      real seconds, ik_rows_t *rows, real *A, real *b,
                                      ik_step_t *s) {
    const int n = ik->n, first = rows->k;
    real wanted[HK_MAX_N], first_step[HK_MAX_N], way[HK_MAX_N], v[IK_ROWS], allowed[IK_ROWS], part = R(1.0);
    const ik_wish_t tried = {wish->q, wish->x, wish->J, wish->e, v, allowed};
    ik_near_t near = ik_near_of(ik);
    for (int i = 0; i < ik->m; i++) v[i] = wish->v[i], allowed[i] = wish->allowed[i];
    ik_find_gaps(ik, wish->q, wish->x, J, &near);
    ik_reaches(ik, s, &near);
    for (int round = 0; round <= IK_AROUND; round++) {
        rows->k = first + ik_gap_rows(ik, &near, seconds, A + n * first, b + first);
        ik_propose(ik, &tried, rows, s);
        if (round == 0) {
            s->blocked = ik_meets(ik, rows, first, s->dq);
            for (int j = 0; j < n; j++) first_step[j] = s->dq[j];
        } else if (ik_is_free(&near) && !(ik_dot(ik->m, s->promised, wish->v) > R(0.0))) {
            for (int j = 0; j < n; j++) s->dq[j] = first_step[j]; /* in a wedge */
            break;
        }
        if (!ik_leads_too_far(ik, wish->q, s->dq, seconds, &near, way)) return;
        s->blocked = 1;
        if (round == IK_AROUND) break;
        const real shorter = ik_tighten(ik, s->dq, way, seconds, &near);
        for (int i = 0; i < ik->m; i++) v[i] *= shorter, allowed[i] *= shorter;
        for (int j = 0; j < n; j++) s->posture[j] *= shorter;
    }
    for (int j = 0; j < n; j++) wanted[j] = s->dq[j];
    for (int halving = 0; halving <= IK_SHORTER; halving++) {
        part = halving < IK_SHORTER ? R(0.5) * part : R(0.0);
        for (int j = 0; j < n; j++) {
            const real brake = ik_clip(R(0.0), s->lower[j], s->upper[j]);
            s->dq[j] = brake + part * (wanted[j] - brake);
            s->held[j] = (unsigned char)((s->dq[j] <= s->lower[j]) | (s->dq[j] >= s->upper[j]));
        }
        if (part > R(0.0) && !ik_leads_too_far(ik, wish->q, s->dq, seconds, &near, way)) break;
    }
    ik_motion(ik, wish->J, s->dq, s->promised);
}
