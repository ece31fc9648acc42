/* The step nearest to a preferred one, within every limit: dq with the least
   |dq - z|^2 + |J dq - v|^2 / lambda^2, lower <= dq <= upper and A dq <= b.

   With s = (v - J dq) / lambda it is the point x = (dq, s) nearest to (z, 0) with
   J dq + lambda s = v. The dual active-set method of Goldfarb & Idnani (Math. Program. 27, 1983),
   with their operators H and N*: the constraint violated most becomes active, and those that would
   push the wrong way leave, until none is violated. It is exact after a finite number of changes,
   of which there are at most IK_CHANGES. */

enum { NEAR_MOST = HK_MAX_N + IK_MOST_ROWS };

/* A problem of n actuators, m rows of a task and k rows of limits of length one, the most important
   ones first. */
typedef struct {
    int n, m, k;
    const real *J, *v, *z, *lower, *upper, *A;
    real *b;          /* relaxed where rows contradict the bounds or more important ones, */
    const real *most; /* at most to these (NULL: no limit) */
    real damping;   /* lambda > 0 */
    real excess;    /* what has been added to lambda^2: proximal rounds take its effect out, */
    real *mu;       /* from these multipliers (m) on, (v - J dq) / lambda^2, which they improve */
    real *work;     /* NEAR_WORK(n, m) numbers */
} near_problem;

/* The active constraints: inequality j is the lower bound of x_j, N + j the upper one and 2 N + i
   row i; NEAR_EQUATION are those of the task. */
enum { NEAR_EQUATION = -1, NEAR_NONE = -2 };
typedef struct {
    int N, count, rounds, chosen, which[NEAR_MOST];
    real close; /* what rounding of all that led to x may be, once it has been seen */
    real x[NEAR_MOST], first[IK_MOST_ROWS], e[IK_MOST_ROWS], force[NEAR_MOST], pushed; /* pushed: by the one chosen */
    real *free;    /* projector (N, N) onto the directions that they leave */
    real *inverse; /* rows (N) of the pseudo-inverse of their normals */
} near_state;

#define NEAR_WORK(n, m) (2 * ((n) + (m)) * ((n) + (m)))
#define NEAR_ROUNDING (R(100.0) * HK_EPS)

/* y (N) = a symmetric matrix times a vector. */
static inline void near_times(int N, const real *matrix, const real *vector, real *y) {
    for (int j = 0; j < N; j++) y[j] = R(0.0);
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++) y[j] += vector[i] * matrix[N * i + j];
}

/* The free part of a normal (N), its square, and its multiples (count) of the active ones. */
static inline real near_along(const near_state *s, const real *normal, real *way, real *shares) {
    const int N = s->N;
    real once[NEAR_MOST], size = R(0.0);
    near_times(N, s->free, normal, once);
    near_times(N, s->free, once, way); /* twice, for rounding */
    for (int j = 0; j < N; j++) size += way[j] * way[j];
    for (int c = 0; c < s->count; c++) {
        shares[c] = R(0.0);
        for (int j = 0; j < N; j++) shares[c] += s->inverse[N * c + j] * normal[j];
    }
    return size;
}

static inline void near_add(near_state *s, const real *way, real size, const real *shares,
                            int which, real force) {
    const int N = s->N, last = s->count++;
    for (int i = 0; i < N; i++) {
        const real a = way[i] / size;
        for (int j = 0; j < N; j++) s->free[N * i + j] -= a * way[j];
    }
    for (int c = 0; c < last; c++) {
        const real a = shares[c] / size;
        for (int j = 0; j < N; j++) s->inverse[N * c + j] -= a * way[j];
    }
    for (int j = 0; j < N; j++) s->inverse[N * last + j] = way[j] / size;
    s->which[last] = which, s->force[last] = force;
}

static inline void near_drop(near_state *s, int slot) {
    const int N = s->N, last = --s->count;
    real way[NEAR_MOST], size = R(0.0);
    for (int j = 0; j < N; j++) {
        way[j] = s->inverse[N * slot + j], size += way[j] * way[j];
        s->inverse[N * slot + j] = s->inverse[N * last + j];
    }
    s->which[slot] = s->which[last], s->force[slot] = s->force[last];
    for (int i = 0; i < N; i++) {
        const real a = way[i] / size;
        for (int j = 0; j < N; j++) s->free[N * i + j] += a * way[j];
    }
    for (int c = 0; c < last; c++) {
        real a = R(0.0);
        for (int j = 0; j < N; j++) a += s->inverse[N * c + j] * way[j];
        for (int j = 0; j < N; j++) s->inverse[N * c + j] -= a / size * way[j];
    }
}

/* The point nearest to (z, 0) on the equations alone. */
static inline void near_begin(const near_problem *p, near_state *s) {
    const int n = p->n, N = s->N = n + p->m;
    real normal[NEAR_MOST], way[NEAR_MOST], shares[NEAR_MOST];
    s->count = 0, s->close = R(0.0), s->chosen = NEAR_NONE, s->rounds = p->excess > R(0.0) ? IK_PROXIMAL : 0;
    for (int j = 0; j < N; j++) s->x[j] = j < n ? p->z[j] : R(0.0);
    for (int i = 0; i < N * N; i++) s->free[i] = i % (N + 1) ? R(0.0) : R(1.0);
    for (int i = 0; i < p->m; i++) {
        real missing = s->e[i] = s->first[i];
        for (int j = 0; j < N; j++) {
            normal[j] = j < n ? p->J[n * i + j] : j == n + i ? p->damping : R(0.0);
            missing -= normal[j] * s->x[j];
        }
        const real size = near_along(s, normal, way, shares);
        for (int j = 0; j < N; j++) s->x[j] += missing / size * way[j];
        near_add(s, way, size, shares, NEAR_EQUATION, R(INFINITY));
    }
}

/* By how much x violates an inequality. */
static inline real near_beyond(const near_problem *p, const near_state *s, int which) {
    const int N = s->N;
    if (which < N) return p->lower[which] - s->x[which];
    if (which < 2 * N) return s->x[which - N] - p->upper[which - N];
    const real *row = p->A + p->n * (which - 2 * N);
    real sum = -p->b[which - 2 * N];
    for (int j = 0; j < p->n; j++) sum += row[j] * s->x[j];
    return sum;
}

static inline real near_largest(const near_state *s) {
    real largest = R(0.0);
    for (int j = 0; j < s->N; j++) largest = ik_abs(s->x[j]) > largest ? ik_abs(s->x[j]) : largest;
    return largest;
}

static inline int near_is_active(const near_state *s, int which) {
    for (int c = 0; c < s->count; c++)
        if (s->which[c] == which) return 1;
    return 0;
}

/* The inequality violated most, by more than rounding, that is not active. */
static inline int near_worst(const near_problem *p, const near_state *s) {
    const int n = p->n, N = s->N;
    const real unit = R(8.0) * HK_EPS;
    real most = R(0.0);
    int worst = NEAR_NONE;
    for (int j = 0; j < n; j++) {
        const real x = s->x[j], low = p->lower[j], high = p->upper[j];
        const int above = x - high > low - x;
        const real beyond = above ? x - high : low - x, end = ik_abs(above ? high : low);
        if (beyond > most && beyond > s->close + unit * (ik_abs(x) + end) &&
            !near_is_active(s, above ? N + j : j))
            most = beyond, worst = above ? N + j : j;
    }
    for (int i = 0; i < p->k; i++) {
        const real *row = p->A + n * i;
        real beyond = -p->b[i], size = ik_abs(p->b[i]);
        for (int j = 0; j < n; j++) {
            const real part = row[j] * s->x[j];
            beyond += part, size += ik_abs(part);
        }
        if (beyond > most && beyond > s->close + unit * size && !near_is_active(s, 2 * N + i))
            most = beyond, worst = 2 * N + i;
    }
    return worst;
}

/* The forces of the active inequalities where x is. */
static inline void near_push(const near_problem *p, near_state *s) {
    for (int c = p->m; c < s->count; c++) {
        s->force[c] = R(0.0);
        for (int j = 0; j < s->N; j++)
            s->force[c] += s->inverse[s->N * c + j] * (s->x[j] - (j < p->n ? p->z[j] : R(0.0)));
    }
}

/* One step of Newton's method onto the active inequalities takes rounding out. */
static inline void near_refine(const near_problem *p, near_state *s) {
    const int N = s->N;
    real off[NEAR_MOST];
    for (int c = p->m; c < s->count; c++) off[c] = near_beyond(p, s, s->which[c]);
    for (int c = p->m; c < s->count; c++)
        for (int j = 0; j < N; j++) s->x[j] += off[c] * s->inverse[N * c + j];
}

/* The multipliers of the equations. */
static inline void near_multipliers(const near_problem *p, const near_state *s) {
    for (int i = 0; i < p->m; i++) {
        p->mu[i] = R(0.0);
        for (int j = 0; j < s->N; j++)
            p->mu[i] += s->inverse[s->N * i + j] * (s->x[j] - (j < p->n ? p->z[j] : R(0.0)));
    }
}

/* Begin a proximal round: new values of the equations; what pulls then is no longer active. */
static inline void near_next_round(const near_problem *p, near_state *s) {
    const int N = s->N;
    real change[IK_MOST_ROWS];
    near_multipliers(p, s);
    for (int i = 0; i < p->m; i++) {
        change[i] = p->v[i] + p->excess * p->mu[i] - s->e[i];
        s->e[i] += change[i];
    }
    for (int i = 0; i < p->m; i++)
        for (int j = 0; j < N; j++) s->x[j] += change[i] * s->inverse[N * i + j];
    for (;;) {
        real least = R(0.0), size = R(0.0);
        int slot = -1;
        near_push(p, s);
        for (int c = p->m; c < s->count; c++)
            if (s->force[c] < least) least = s->force[c], slot = c;
        if (slot < 0) break;
        for (int j = 0; j < N; j++) size += s->inverse[N * slot + j] * s->inverse[N * slot + j];
        for (int j = 0; j < N; j++) s->x[j] -= least / size * s->inverse[N * slot + j];
        near_drop(s, slot);
    }
    near_refine(p, s);
}

/* Relax the least important of the rows that contradict the one chosen, which is `missing` and a sum
   of active normals with factors `shares`, none positive; all begins anew. Where none is a row it is
   rounding, else the bounds contradict each other: returns 0. */
static inline int near_relax(const near_problem *p, near_state *s, real missing,
                             const real *shares) {
    int least = NEAR_NONE;
    real factor = R(1.0);
    for (int c = p->m - 1; c < s->count; c++) {
        const int which = c < p->m ? s->chosen : s->which[c], row = which - 2 * s->N;
        if (c >= p->m && !(shares[c] < -NEAR_ROUNDING)) continue;
        if (row < 0 || which <= least || (p->most && p->b[row] >= p->most[row])) continue;
        least = which, factor = c < p->m ? R(1.0) : -shares[c];
    }
    if (least < 0) {
        const real close = R(8.0) * HK_EPS * near_largest(s);
        if (missing > close || s->close > R(0.0)) return 0;
        s->close = close, s->chosen = NEAR_NONE;
        return 1;
    }
    real *b = p->b + least - 2 * s->N;
    *b += missing / factor + R(32.0) * HK_EPS * (ik_abs(*b) + missing / factor);
    if (p->most) *b = *b < p->most[least - 2 * s->N] ? *b : p->most[least - 2 * s->N];
    near_begin(p, s);
    return 1;
}

/* Make the chosen inequality hold, or drop the first active one that pushes no more on the way.
   Returns 0 if it contradicts bounds alone. */
static inline int near_change(const near_problem *p, near_state *s) {
    const int n = p->n, N = s->N, which = s->chosen;
    real normal[NEAR_MOST], way[NEAR_MOST], shares[NEAR_MOST];
    for (int j = 0; j < N; j++) {
        if (which < 2 * N) normal[j] = j == which ? R(1.0) : j == which - N ? R(-1.0) : R(0.0);
        else normal[j] = j < n ? -p->A[n * (which - 2 * N) + j] : R(0.0);
    }
    const real size = near_along(s, normal, way, shares), missing = near_beyond(p, s, which);
    const int movable = size > NEAR_ROUNDING * NEAR_ROUNDING;
    real length = movable ? missing / size : R(INFINITY);
    int slot = -1;
    for (int c = p->m; c < s->count; c++)
        if (shares[c] > NEAR_ROUNDING && s->force[c] / shares[c] < length)
            length = s->force[c] / shares[c], slot = c;
    if (!(length < R(INFINITY))) return near_relax(p, s, missing, shares);
    for (int j = 0; movable && j < N; j++) s->x[j] += length * way[j];
    for (int c = p->m; c < s->count; c++) s->force[c] -= length * shares[c];
    s->pushed += length;
    if (slot < 0) near_add(s, way, size, shares, which, s->pushed), s->chosen = NEAR_NONE;
    else near_drop(s, slot);
    near_refine(p, s);
    return 1;
}

/* dq (n), exactly within the bounds, and at those that it reaches up to rounding. */
static HK_NOINLINE void ik_nearest(const near_problem *p, real *dq) {
    near_state s;
    s.free = p->work, s.inverse = p->work + (p->n + p->m) * (p->n + p->m);
    for (int i = 0; i < p->m; i++) s.first[i] = p->v[i] + p->excess * p->mu[i];
    near_begin(p, &s);
    for (int change = 0; change < IK_CHANGES; change++) {
        if (s.chosen < 0) s.chosen = near_worst(p, &s), s.pushed = R(0.0);
        if (s.chosen < 0) {
            if (s.rounds-- <= 0) break;
            near_next_round(p, &s);
        } else if (!near_change(p, &s))
            break;
    }
    near_multipliers(p, &s);
    s.N = p->n; /* without the slack */
    const real unit = IK_CLOSE * HK_EPS, close = unit * near_largest(&s);
    for (int j = 0; j < p->n; j++) {
        dq[j] = s.x[j];
        const real low = p->lower[j], high = p->upper[j];
        if (low > -R(INFINITY) && dq[j] - low <= close + unit * ik_abs(low)) dq[j] = low;
        if (high < R(INFINITY) && high - dq[j] <= close + unit * ik_abs(high)) dq[j] = high;
    }
}
