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
    real damping;     /* lambda > 0 */
    real excess;      /* what has been added to lambda^2: proximal rounds take its effect out, */
    real *mu;         /* from these multipliers (m) on, (v - J dq) / lambda^2, which they improve */
    real *work;       /* NEAR_WORK(n, m) numbers */
} near_problem;

/* The active constraints: inequality j is the lower bound of x_j, N + j the upper one and 2 N + i
   row i; NEAR_EQUATION are those of the task. */
enum { NEAR_EQUATION = -1, NEAR_NONE = -2 };
typedef struct {
    int count, rounds, refined, chosen, which[NEAR_MOST];
    real close; /* what rounding of all that led to x may be, once it has been seen */
    real begun[NEAR_MOST]; /* x on the equations alone */
    real x[NEAR_MOST], first[IK_MOST_ROWS], e[IK_MOST_ROWS], force[NEAR_MOST];
    real pushed;   /* by the one chosen */
    real *free;    /* projector (N, N) onto the directions that they leave */
    real *inverse; /* rows (N) of the pseudo-inverse of their normals */
} near_state;

#define NEAR_WORK(n, m) (2 * ((n) + (m)) * ((n) + (m)))
/* What rounding may leave of a component of a unit vector that is zero: eps^(2/3). */
#ifdef HK_FLOAT
#define NEAR_ROUNDING R(2.4e-5)
#else
#define NEAR_ROUNDING R(3.7e-11)
#endif

/* y (N) = a symmetric matrix times a vector. */
HK_INLINE void near_times(int N, const real *matrix, const real *vector, real *y) {
    for (int j = 0; j < N; j++) y[j] = R(0.0);
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++) y[j] += vector[i] * matrix[N * i + j];
}

/* The free part of a normal (N), its square, and its multiples (count) of the active ones. `unit`:
   the only coordinate that is not 0, -1 for a normal of several. */
HK_INLINE real near_along(int n, int m, const near_state *s, const real *normal, int unit, real *way,
                              real *shares) {
    const int N = n + m;
    real size = R(0.0), length = R(0.0);
    if (unit >= 0)
        for (int j = 0; j < N; j++) way[j] = normal[unit] * s->free[N * unit + j];
    else
        near_times(N, s->free, normal, way);
    for (int j = 0; j < N; j++) size += way[j] * way[j], length += normal[j] * normal[j];
    if (size < R(0.25) * length) { /* once more, for rounding */
        real once[NEAR_MOST];
        for (int j = 0; j < N; j++) once[j] = way[j];
        near_times(N, s->free, once, way);
        size = R(0.0);
        for (int j = 0; j < N; j++) size += way[j] * way[j];
    }
    for (int c = 0; c < s->count; c++) {
        shares[c] = R(0.0);
        if (unit >= 0)
            shares[c] = normal[unit] * s->inverse[N * c + unit];
        else
            for (int j = 0; j < N; j++) shares[c] += s->inverse[N * c + j] * normal[j];
    }
    return size;
}

HK_INLINE void near_add(int n, int m, near_state *s, const real *way, real size, const real *shares,
                            int which, real force) {
    const int N = n + m, last = s->count++;
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

HK_INLINE void near_drop(int n, int m, near_state *s, int slot) {
    const int N = n + m, last = --s->count;
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
HK_INLINE void near_begin(int n, int m, const near_problem *p, near_state *s) {
    const int N = n + m;
    real normal[NEAR_MOST], way[NEAR_MOST], shares[NEAR_MOST];
    s->count = 0, s->refined = 1, s->close = R(0.0), s->chosen = NEAR_NONE, s->rounds = p->excess > R(0.0) ? IK_PROXIMAL : 0;
    for (int j = 0; j < N; j++) s->x[j] = j < n ? p->z[j] : R(0.0);
    for (int i = 0; i < N * N; i++) s->free[i] = i % (N + 1) ? R(0.0) : R(1.0);
    for (int i = 0; i < m; i++) {
        real missing = s->e[i] = s->first[i];
        for (int j = 0; j < N; j++) {
            normal[j] = j < n ? p->J[n * i + j] : j == n + i ? p->damping : R(0.0);
            missing -= normal[j] * s->x[j];
        }
        const real size = near_along(n, m, s, normal, -1, way, shares);
        for (int j = 0; j < N; j++) s->x[j] += missing / size * way[j];
        near_add(n, m, s, way, size, shares, NEAR_EQUATION, R(INFINITY));
    }
    for (int j = 0; j < N; j++) s->begun[j] = s->x[j];
}

/* By how much x violates an inequality. */
HK_INLINE real near_beyond(int n, int m, const near_problem *p, const near_state *s, int which) {
    const int N = n + m;
    if (which < N) return p->lower[which] - s->x[which];
    if (which < 2 * N) return s->x[which - N] - p->upper[which - N];
    const real *row = p->A + n * (which - 2 * N);
    real sum = -p->b[which - 2 * N];
    for (int j = 0; j < n; j++) sum += row[j] * s->x[j];
    return sum;
}

/* The size of what has been added in an inequality, here and at the beginning. */
HK_INLINE real near_size(int n, int m, const near_problem *p, const near_state *s, int which) {
    const int N = n + m, j = which % N;
    const real place = ik_abs(s->x[j]) + ik_abs(s->begun[j]);
    if (which < N) return R(2.0) * ik_abs(p->lower[which]) + place;
    if (which < 2 * N) return R(2.0) * ik_abs(p->upper[which - N]) + place;
    const real *row = p->A + n * (which - 2 * N);
    real sum = R(2.0) * ik_abs(p->b[which - 2 * N]);
    for (int i = 0; i < n; i++) sum += ik_abs(row[i]) * (ik_abs(s->x[i]) + ik_abs(s->begun[i]));
    return sum;
}

static inline real ik_largest(int n, const real *a) {
    real largest = R(0.0);
    for (int j = 0; j < n; j++) largest = ik_abs(a[j]) > largest ? ik_abs(a[j]) : largest;
    return largest;
}

HK_INLINE int near_is_active(const near_state *s, int which) {
    for (int c = 0; c < s->count; c++)
        if (s->which[c] == which) return 1;
    return 0;
}

/* The inequality violated most, by more than rounding, that is not active. */
HK_INLINE int near_worst(int n, int m, const near_problem *p, const near_state *s) {
    const int N = n + m;
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
HK_INLINE void near_push(int n, int m, const near_problem *p, near_state *s) {
    for (int c = m; c < s->count; c++) {
        s->force[c] = R(0.0);
        for (int j = 0; j < (n + m); j++)
            s->force[c] += s->inverse[(n + m) * c + j] * (s->x[j] - (j < n ? p->z[j] : R(0.0)));
    }
}

/* One step of Newton's method onto the active inequalities takes rounding out. */
HK_INLINE void near_refine(int n, int m, const near_problem *p, near_state *s) {
    const int N = n + m;
    real off[NEAR_MOST];
    for (int c = m; c < s->count; c++) off[c] = near_beyond(n, m, p, s, s->which[c]);
    for (int c = m; c < s->count; c++)
        for (int j = 0; j < N; j++) s->x[j] += off[c] * s->inverse[N * c + j];
    s->refined = 1;
}

/* The multipliers of the equations. */
HK_INLINE void near_multipliers(int n, int m, const near_problem *p, const near_state *s) {
    for (int i = 0; i < m; i++) {
        p->mu[i] = R(0.0);
        for (int j = 0; j < (n + m); j++)
            p->mu[i] += s->inverse[(n + m) * i + j] * (s->x[j] - (j < n ? p->z[j] : R(0.0)));
    }
}

/* Begin a proximal round: new values of the equations; what pulls then is no longer active. */
HK_INLINE void near_next_round(int n, int m, const near_problem *p, near_state *s) {
    const int N = n + m;
    real change[IK_MOST_ROWS];
    near_multipliers(n, m, p, s);
    for (int i = 0; i < m; i++) {
        change[i] = p->v[i] + p->excess * p->mu[i] - s->e[i];
        s->e[i] += change[i];
    }
    for (int i = 0; i < m; i++)
        for (int j = 0; j < N; j++) s->x[j] += change[i] * s->inverse[N * i + j];
    for (;;) {
        real least = R(0.0), size = R(0.0);
        int slot = -1;
        near_push(n, m, p, s);
        for (int c = m; c < s->count; c++)
            if (s->force[c] < least) least = s->force[c], slot = c;
        if (slot < 0) break;
        for (int j = 0; j < N; j++) size += s->inverse[N * slot + j] * s->inverse[N * slot + j];
        for (int j = 0; j < N; j++) s->x[j] -= least / size * s->inverse[N * slot + j];
        near_drop(n, m, s, slot);
    }
    near_refine(n, m, p, s);
}

/* Relax the least important of the rows that contradict the one chosen, which is `missing` and a sum
   of active normals with factors `shares`, none positive; all begins anew. What is as small as rounding
   is none. Where none is a row the bounds contradict each other: returns 0. */
HK_INLINE int near_relax(int n, int m, const near_problem *p, near_state *s, real missing,
                             const real *shares) {
    const real close = IK_SAME * HK_EPS * near_size(n, m, p, s, s->chosen);
    int least = NEAR_NONE;
    real factor = R(1.0);
    if (missing <= close && !(s->close > R(0.0))) { /* rounding: nothing begins anew */
        s->close = close, s->chosen = NEAR_NONE;
        return 1;
    }
    for (int c = m - 1; c < s->count; c++) {
        const int which = c < m ? s->chosen : s->which[c], row = which - 2 * (n + m);
        if (c >= m && !(shares[c] < -NEAR_ROUNDING)) continue;
        if (row < 0 || which <= least || (p->most && p->b[row] >= p->most[row])) continue;
        least = which, factor = c < m ? R(1.0) : -shares[c];
    }
    if (least < 0) return 0;
    real *b = p->b + least - 2 * (n + m);
    *b += missing / factor + R(32.0) * HK_EPS * (ik_abs(*b) + missing / factor);
    if (p->most) *b = *b < p->most[least - 2 * (n + m)] ? *b : p->most[least - 2 * (n + m)];
    near_begin(n, m, p, s);
    return 1;
}

/* Make the chosen inequality hold, or drop the first active one that pushes no more on the way.
   Returns 0 if it contradicts bounds alone. */
HK_INLINE int near_change(int n, int m, const near_problem *p, near_state *s) {
    const int N = n + m, which = s->chosen;
    real normal[NEAR_MOST], way[NEAR_MOST], shares[NEAR_MOST];
    for (int j = 0; j < N; j++) {
        if (which < 2 * N) normal[j] = j == which ? R(1.0) : j == which - N ? R(-1.0) : R(0.0);
        else normal[j] = j < n ? -p->A[n * (which - 2 * N) + j] : R(0.0);
    }
    const int unit = which < N ? which : which < 2 * N ? which - N : -1;
    const real size = near_along(n, m, s, normal, unit, way, shares);
    const real missing = near_beyond(n, m, p, s, which);
    const int movable = size > NEAR_ROUNDING * NEAR_ROUNDING;
    real length = movable ? missing / size : R(INFINITY);
    int slot = -1;
    for (int c = m; c < s->count; c++)
        if (shares[c] > NEAR_ROUNDING && s->force[c] / shares[c] < length)
            length = s->force[c] / shares[c], slot = c;
    if (!(length < R(INFINITY))) return near_relax(n, m, p, s, missing, shares);
    for (int j = 0; movable && j < N; j++) s->x[j] += length * way[j];
    for (int c = m; c < s->count; c++) s->force[c] -= length * shares[c];
    s->pushed += length;
    if (slot < 0) near_add(n, m, s, way, size, shares, which, s->pushed), s->chosen = NEAR_NONE;
    else near_drop(n, m, s, slot);
    s->refined = 0;
    return 1;
}

/* dq (n), exactly within the bounds, and at those that it reaches up to rounding. */
HK_INLINE void ik_nearest_of(int n, int m, const near_problem *p, real *dq) {
    near_state s;
    s.free = p->work, s.inverse = p->work + (n + m) * (n + m);
    for (int i = 0; i < m; i++) s.first[i] = p->v[i] + p->excess * p->mu[i];
    near_begin(n, m, p, &s);
    for (int change = 0; change < IK_CHANGES; change++) {
        if (s.chosen < 0) s.chosen = near_worst(n, m, p, &s), s.pushed = R(0.0);
        if (s.chosen < 0 && !s.refined) {
            near_refine(n, m, p, &s);
        } else if (s.chosen < 0) {
            if (s.rounds-- <= 0) break;
            near_next_round(n, m, p, &s);
        } else if (!near_change(n, m, p, &s))
            break;
    }
    near_multipliers(n, m, p, &s);
    const real unit = IK_CLOSE * HK_EPS, close = unit * ik_largest(n, s.x); /* not of the slack */
    for (int j = 0; j < n; j++) {
        const real low = p->lower[j], high = p->upper[j];
        dq[j] = ik_clip(s.x[j], low, high);
        if (low > -R(INFINITY) && dq[j] - low <= close + unit * ik_abs(low)) dq[j] = low;
        if (high < R(INFINITY) && high - dq[j] <= close + unit * ik_abs(high)) dq[j] = high;
    }
}

static HK_NOINLINE void ik_nearest(const near_problem *p, real *dq) {
    switch (HK_COMMON(100 * p->m + p->n)) { /* loops of known length */
    case 306: ik_nearest_of(6, 3, p, dq); break;
    case 309: ik_nearest_of(9, 3, p, dq); break;
    case 606: ik_nearest_of(6, 6, p, dq); break;
    default: ik_nearest_of(p->n, p->m, p, dq);
    }
}
