/* One step of inverse kinematics for a position (m = 3 rows) or, in a search, a pose (6): the
   damped inverse, a posture in its null space, and limits inside the step. One row at a time. */

#include "ik_box.h"

/* The settings: limits of q, of its speed and acceleration, posture, and units in which nothing has
   a weight. */
typedef struct {
    hk_plan plan;
    real *work;                        /* memory of a call */
    int model, n, m, flags, n_normals; /* last: of the plane to keep to */
    const real *low, *high, *speed, *accel, *posture, *unit, *period, *pulls, *normals;
    real gain, beta, dt, damping; /* gain < 0: 1 / dt; damping < 0: adaptive */
    real radian;                  /* what a radian of a pose counts */
} ik_settings;

/* A step: its bounds and the posture step, which go in, and what comes out. */
typedef struct {
    real lower[HK_MAX_N], upper[HK_MAX_N], posture[HK_MAX_N];
    real dq[HK_MAX_N], sigma_min, damping;
    unsigned char held[HK_MAX_N];
} ik_step_t;

static inline ik_settings ik_settings_of(const int32_t *code, const real *data, int at,
                                         real *work) {
    const int32_t *node = code + at;
    const int n = node[HK_N];
    const real *a = data + node[HK_DATA], *b = a + 6 * n;
    const ik_settings ik = {
        .plan = {code, data},
        .work = work,
        .model = node[HK_MORE],
        .n = n,
        .m = node[HK_M],
        .flags = node[HK_MORE + 1],
        .n_normals = node[HK_MORE + 2],
        .low = a,
        .high = a + n,
        .speed = a + 2 * n,
        .accel = a + 3 * n,
        .posture = a + 4 * n,
        .unit = a + 5 * n,
        .gain = b[0],
        .beta = b[1],
        .dt = b[2],
        .damping = b[3],
        .radian = b[4],
        .period = b + 5,
        .pulls = b + 5 + n,
        .normals = b + 5 + 2 * n,
    };
    return ik;
}

/* lambda^2, zero for a healthy J and growing smoothly from there (Nakamura & Hanafusa, 1986). */
static inline real ik_damping_sq(const ik_settings *ik, real low, real high) {
    if (ik->damping >= R(0.0)) return ik->damping * high * (ik->damping * high);
    const real bound = IK_HEALTHY * high, ratio = low / (bound > R(0.0) ? bound : R(1.0));
    const real lack = R(1.0) - ratio * ratio, lambda = bound * (lack < R(0.0) ? R(0.0) : lack);
    return lambda * lambda;
}

/* Take the part normal to the plane out of the motions a (rows, n). */
static inline void ik_in_plane(const ik_settings *ik, int rows, real *a) {
    for (int i = 0; i < rows; i++, a += ik->n)
        for (int k = 0; k < ik->n_normals; k++) {
            const real *normal = ik->normals + k * ik->n;
            real off = R(0.0);
            for (int j = 0; j < ik->n; j++) off += a[j] * normal[j];
            for (int j = 0; j < ik->n; j++) a[j] -= off * normal[j];
        }
}

/* Solve for a step at its limits with further rows, so that only the posture step `aside` (NULL:
   none) leaves the plane: else a limit that stops one actuator would unbalance the others. */
static HK_NOINLINE void ik_limited_in_plane(const ik_settings *ik, const real *J, const real *v,
                                            const real *z, const real *aside, const real *lower,
                                            const real *upper, real damping_sq, real *dq) {
    const int n = ik->n, m = ik->m;
    real rows[IK_MOST_ROWS * HK_MAX_N], motion[IK_MOST_ROWS], g[IK_MOST_PAIRS];
    const real stiff = IK_BALANCE * ik_norm(m * n, J);
    for (int i = 0; i < m * n; i++) rows[i] = J[i];
    for (int i = 0; i < m; i++) motion[i] = v[i];
    for (int k = 0; k < ik->n_normals; k++) {
        real *row = rows + (m + k) * n;
        motion[m + k] = R(0.0);
        for (int j = 0; j < n; j++) {
            row[j] = stiff * (ik->normals[k * n + j] * ik->unit[j]);
            motion[m + k] += aside ? row[j] * (aside[j] / ik->unit[j]) : R(0.0);
        }
    }
    ik_products(m + ik->n_normals, n, rows, NULL, g);
    ik_strict_box(m + ik->n_normals, n, rows, g, motion, z, lower, upper, damping_sq, dq);
}

/* Fill in a step for the task v within its bounds; `slides`: with its posture step. `trust` is
   lambda^2 / sigma_max^2 in place of the settings' damping, NULL where that counts. */
HK_INLINE void ik_limited_step_of(int m, int n, const ik_settings *ik, const real *J, const real *v,
                                  int slides, const real *trust, ik_step_t *s) {
    real own[(IK_ROWS + 2) * HK_MAX_N], z[HK_MAX_N], mu[IK_ROWS], g[IK_PAIRS];
    real low = R(0.0), high, damping_sq, *dq = s->dq;
    const real *lower = s->lower, *upper = s->upper;
    for (int j = 0; j < n; j++) z[j] = slides ? s->posture[j] : R(0.0);
    if (ik->flags & IK_WEIGHTS) {
        for (int j = 0; j < n; j++) {
            for (int i = 0; i < m; i++) own[n * i + j] = J[n * i + j] * ik->unit[j];
            own[m * n + j] = lower[j] / ik->unit[j];
            own[(m + 1) * n + j] = upper[j] / ik->unit[j];
            z[j] = z[j] / ik->unit[j];
        }
        J = own, lower = own + m * n, upper = own + (m + 1) * n;
    }
    ik_products(m, n, J, NULL, g);
    if (trust)
        damping_sq = *trust * ik_trace(m, g);
    else {
        if (m == 3)
            ik_singular_values(g, &low, &high);
        else
            ik_pivots(m, g, &low, &high);
        damping_sq = ik_damping_sq(ik, low, high);
    }
    const ik_factors f = ik_factor(m, g, damping_sq);
    ik_solve(m, &f, v, mu);
    if (slides) ik_null_projection(m, n, J, g, z);
    ik_columns_of(m, n, J, mu, z, dq);
    if (ik->flags & IK_LIMITED) {
        int over =
            ik->n_normals > 0 && ik->flags & IK_WEIGHTS; /* weights turn J out of the plane */
        for (int j = 0; j < n; j++) over |= ik_clip(dq[j], lower[j], upper[j]) != dq[j];
        if (over && ik->n_normals > 0)
            ik_limited_in_plane(ik, J, v, z, slides ? s->posture : NULL, lower, upper, damping_sq,
                                dq);
        else if (over)
            ik_strict_box(m, n, J, g, v, z, lower, upper, damping_sq, dq);
    }
    for (int j = 0; j < n; j++) {
        s->held[j] = (unsigned char)((dq[j] <= lower[j]) | (dq[j] >= upper[j]));
        if (ik->flags & IK_WEIGHTS) dq[j] = ik_clip(dq[j] * ik->unit[j], s->lower[j], s->upper[j]);
    }
    s->sigma_min = low;
    s->damping = HK_MATH(sqrt)(damping_sq);
}

static HK_NOINLINE void ik_limited_step(const ik_settings *ik, const real *J, const real *v,
                                        int slides, const real *trust, ik_step_t *s) {
    switch (HK_COMMON(100 * ik->m + ik->n)) {
    case 306: ik_limited_step_of(3, 6, ik, J, v, slides, trust, s); break;
    case 309: ik_limited_step_of(3, 9, ik, J, v, slides, trust, s); break;
    case 606: ik_limited_step_of(6, 6, ik, J, v, slides, trust, s); break;
    default: IK_OF(ik->m, ik_limited_step_of, ik->n, ik, J, v, slides, trust, s);
    }
}

static inline real ik_larger(real a, real b) { return a > b ? a : b; }

/* The largest first step for which steps that shrink by `change` stop within `way`. */
static inline real ik_stopping(real way, real change) {
    if (!(way > R(0.0) && way < R(INFINITY))) return way;
    return way / (R(0.5) + R(0.5) * HK_MATH(sqrt)(R(1.0) + R(2.0) * (way / change)));
}

/* The bounds of a step: position, and for `seconds` > 0 speed and acceleration from the step
   `last` (NULL: at rest), intersected, never empty. From outside the limits both meet at the way
   back, of a speed that cannot be stopped at the hardest braking. q + dq stays in the limits after
   rounding. */
static inline void ik_step_bounds(const ik_settings *ik, const real *q, real seconds,
                                  const real *last, ik_step_t *s) {
    const real far = R(INFINITY);
    const int accelerates = ik->flags & IK_ACCELERATES && seconds > R(0.0);
    for (int j = 0; j < ik->n; j++) {
        real lower = -far, upper = far;
        if (ik->flags & IK_LIMITED) {
            const real change = accelerates ? ik->accel[j] * seconds * seconds : far;
            const real from = last ? last[j] : R(0.0);
            lower = ik->low[j] - q[j], upper = ik->high[j] - q[j];
            if (q[j] + upper > ik->high[j]) upper = HK_MATH(nextafter)(upper, -far);
            if (q[j] + lower < ik->low[j]) lower = HK_MATH(nextafter)(lower, far);
            if (accelerates)
                lower = -ik_stopping(-lower, change), upper = ik_stopping(upper, change);
            if (seconds > R(0.0)) {
                const real most = ik->speed[j] * seconds;
                lower = ik_clip(lower, -most, most), upper = ik_clip(upper, -most, most);
            }
            if (accelerates) {
                lower = ik_clip(lower, from - change, from + change);
                upper = ik_clip(upper, from - change, from + change);
            }
        }
        s->lower[j] = lower, s->upper[j] = upper;
    }
}

/* Limit the speed towards target and posture so that the actuators can brake in time: shorten the
   posture step, and return the share of the error e that may be taken back. */
static inline real ik_brake(const ik_settings *ik, const real *q, const real *J, const real *e,
                            real seconds, ik_step_t *s) {
    real least = R(INFINITY);
    for (int j = 0; j < ik->n; j++) s->lower[j] = -least, s->upper[j] = least;
    ik_limited_step(ik, J, e, 0, NULL, s);
    for (int j = 0; j < ik->n; j++) {
        const real change = ik->accel[j] * seconds * seconds, ratio = change / ik_abs(s->dq[j]);
        const real most = ik_stopping(ik_abs(ik->posture[j] - q[j]), change);
        least = ratio < least ? ratio : least;
        s->posture[j] = ik_clip(s->posture[j], -most, most);
    }
    return ik_stopping(R(1.0), least);
}

/* The model at one configuration. Every step and tick calls this one, and gets the same bits; who
   includes this file writes it. */
static void ik_model(const ik_settings *ik, const real *q, real *x, real *J, real *distance);

/* A step of a model whose Jacobian jumps where tendons get slack or taut: J where it ends, and what
   is missing there of the motion of the tip, as the model computes it. */
typedef struct {
    real dq[HK_MAX_N], J[3 * HK_MAX_N], missing[3], distance;
} ik_end;

/* Clear what a learned error makes of the columns of slack tendons: it would drive them far. */
static void ik_clear_slack(const ik_settings *ik, real *J) {
    real size[HK_MAX_N], largest = R(0.0);
    for (int j = 0; j < ik->n; j++) {
        const real column[3] = {J[j], J[ik->n + j], J[2 * ik->n + j]};
        size[j] = ik_norm(3, column);
        largest = ik_larger(size[j], largest);
    }
    for (int j = 0; j < ik->n; j++)
        if (ik->pulls[j] != R(0.0) && size[j] <= IK_SLACK * largest)
            for (int i = 0; i < 3; i++) J[ik->n * i + j] = R(0.0);
}

static void ik_evaluate(const ik_settings *ik, const real *q, const real *x, const real *motion,
                        ik_end *end) {
    real at[HK_MAX_N], tip[3];
    for (int j = 0; j < ik->n; j++) at[j] = q[j] + end->dq[j];
    ik_model(ik, at, tip, end->J, NULL);
    ik_in_plane(ik, 3, end->J);
    ik_clear_slack(ik, end->J);
    for (int i = 0; i < 3; i++) end->missing[i] = motion[i] - (tip[i] - x[i]);
    end->distance = ik_norm(3, end->missing);
}

/* Newton's method for a motion of the tip, from an end and within the bounds of the step: the
   nearest of a few ends. */
static void ik_approach(const ik_settings *ik, const real *q, const real *x, const real *motion,
                        real close, const ik_step_t *s, ik_end *best) {
    ik_evaluate(ik, q, x, motion, best);
    ik_end end = *best;
    for (int i = 0; i < IK_CORRECTIONS && best->distance > close; i++) {
        ik_step_t more;
        for (int j = 0; j < ik->n; j++) {
            more.lower[j] = s->lower[j] - end.dq[j];
            more.upper[j] = s->upper[j] - end.dq[j];
        }
        ik_limited_step(ik, end.J, end.missing, 0, NULL, &more);
        for (int j = 0; j < ik->n; j++) {
            end.dq[j] = ik_clip(end.dq[j] + more.dq[j], s->lower[j], s->upper[j]);
            if (more.dq[j] <= more.lower[j]) end.dq[j] = s->lower[j]; /* to the last bit */
            if (more.dq[j] >= more.upper[j]) end.dq[j] = s->upper[j];
        }
        ik_evaluate(ik, q, x, motion, &end);
        if (end.distance < best->distance) *best = end;
    }
}

/* Pull in slack tendons by a share of the way to the bounds; return whether any moved. */
static int ik_pull_in(const ik_settings *ik, const ik_step_t *s, real share, ik_end *end) {
    int moved = 0;
    for (int j = 0; j < ik->n; j++) {
        const real to = ik->pulls[j] < R(0.0) ? s->lower[j] : s->upper[j], way = to - end->dq[j];
        const real column[3] = {end->J[j], end->J[ik->n + j], end->J[2 * ik->n + j]};
        if (ik->pulls[j] == R(0.0) || ik_norm(3, column) > R(0.0) || !ik_finite(1, &way)) continue;
        end->dq[j] = ik_clip(to - (R(1.0) - share) * way, s->lower[j], s->upper[j]);
        moved |= way != R(0.0);
    }
    return moved;
}

/* Change a step so that the tip of the model moves as the step promised. Where that is less than
   half of the motion v, pull in slack tendons, as far as the tip gets nearer to v or not away. */
static void ik_arrive(const ik_settings *ik, const real *q, const real *x, const real *J,
                      const real *v, ik_step_t *s) {
    const int n = ik->n;
    const real slip =
        ik_norm(3 * n, J) * (IK_SLIP * ik_norm(n, s->dq) + R(32.0) * HK_EPS * ik_norm(n, q));
    real promised[3], left[3];
    ik_end end;
    ik_rows_of(3, n, J, s->dq, promised);
    for (int j = 0; j < n; j++) end.dq[j] = s->dq[j];
    ik_approach(ik, q, x, promised, ik_larger(R(0.5) * ik_norm(3, promised), slip), s, &end);
    for (int i = 0; i < 3; i++) left[i] = v[i] - promised[i] + end.missing[i];
    const real rounding = R(1.0) + HK_MATH(sqrt)(HK_EPS); /* a slack tendon does not move the tip */
    const real most = ik_norm(3, left), close = ik_larger(R(0.5) * ik_norm(3, v), slip);
    for (real share = R(1.0); most > close && share > IK_LEAST_PULL; share *= IK_PULL_RATIO) {
        ik_end pulled = end;
        if (!ik_pull_in(ik, s, share, &pulled)) break;
        ik_approach(ik, q, x, v, slip, s, &pulled);
        if (pulled.distance > rounding * most) continue;
        end = pulled;
        break;
    }
    for (int j = 0; j < n; j++) {
        s->dq[j] = end.dq[j];
        s->held[j] = (unsigned char)((s->dq[j] <= s->lower[j]) | (s->dq[j] >= s->upper[j]));
    }
}

/* Eq. (1) for one period from q: the error e and the motion `feed` of the target (may be NULL) are
   taken back. What is not finite, or overflows, holds still, with a limit of acceleration after it
   has braked; from outside the limits the actuators that are known walk back. */
static HK_NOINLINE void ik_control(const ik_settings *ik, const real *q, const real *x,
                                   const real *J, const real *e, const real *feed, real seconds,
                                   const real *last, ik_step_t *s) {
    const int n = ik->n;
    real taut[3 * HK_MAX_N], v[3], gain = ik->gain < R(0.0) ? R(1.0) : ik->gain * seconds,
                                   beta = ik->beta * seconds;
    gain = gain > R(1.0) ? R(1.0) : gain;
    beta = beta > R(1.0) ? R(1.0) : beta;
    for (int i = 0; i < 3; i++) v[i] = gain * e[i] + (feed ? feed[i] : R(0.0));
    const real sizes[2] = {ik_norm(3, e), ik_norm(3, v)};
    const int known = !last || ik_finite(n, last);
    if (known && ik_finite(n, q) && ik_finite(3 * n, J) && ik_finite(2, sizes)) {
        if (ik->flags & IK_PULLS) {
            for (int j = 0; j < 3 * n; j++) taut[j] = J[j];
            ik_clear_slack(ik, taut);
            J = taut;
        }
        for (int j = 0; j < n; j++) s->posture[j] = beta * (ik->posture[j] - q[j]);
        if (ik->flags & IK_ACCELERATES) {
            const real share = ik_brake(ik, q, J, e, seconds, s);
            for (int i = 0; i < 3; i++)
                v[i] = (share < gain ? share : gain) * e[i] + (feed ? feed[i] : R(0.0));
        }
        ik_step_bounds(ik, q, seconds, last, s);
        ik_limited_step(ik, J, v, ik->flags & IK_POSTURE, NULL, s);
        if (ik->flags & IK_PULLS && ik_finite(n, s->dq)) ik_arrive(ik, q, x, J, v, s);
        if (ik_finite(n, s->dq)) return; /* else v is too large to compute with */
    }
    ik_step_bounds(ik, q, seconds, known ? last : NULL, s);
    for (int j = 0; j < n; j++) {
        s->dq[j] = ik_finite(1, q + j) ? ik_clip(R(0.0), s->lower[j], s->upper[j]) : R(0.0);
        s->held[j] = (unsigned char)((s->dq[j] <= s->lower[j]) | (s->dq[j] >= s->upper[j]));
    }
    s->sigma_min = R(NAN), s->damping = R(0.0);
}

enum { IK_STATE = IK_Q + 7 * HK_MAX_N }; /* numbers of the state at most */

/* One period of a robot that follows targets. */
static inline void ik_tick(const ik_settings *ik, real *state) {
    const int n = ik->n, mode = (int)state[IK_MODE];
    const real *target = state + IK_TARGET, *tip = state + IK_TIP, period = state[IK_PERIOD];
    real *q = state + IK_Q, *dq = q + n, *before = q + 2 * n, *held = q + 3 * n, *J = q + 4 * n;
    real *x = state + IK_X, *error = state + IK_ERROR, *offset = state + IK_OFFSET;
    const real memory = state[IK_MEMORY];
    real used[3] = {R(0.0), R(0.0), R(0.0)}, *last = NULL, moved[HK_MAX_N];
    ik_step_t step;
    ik_model(ik, q, x, J, NULL);
    ik_in_plane(ik, 3, J);
    for (int i = 0; i < 3; i++) error[i] = R(NAN);
    if (mode & IK_HAS_TARGET) {
        real apart[3];
        for (int i = 0; i < 3; i++) {
            used[i] = target[i] - x[i];
            error[i] = mode & IK_HAS_TIP ? target[i] - tip[i] : used[i];
            apart[i] = used[i] - error[i];
        }
        if (mode & IK_HAS_TIP) {
            /* Without a measurement, use the model's error corrected by the remembered offset;
               without memory, use no error. */
            const int seen = mode & IK_MUST_SEE || ik_finite(3, apart);
            for (int i = 0; i < 3; i++) {
                used[i] = seen ? error[i] : used[i] - (memory > R(0.0) ? offset[i] : used[i]);
                offset[i] = seen ? apart[i] : offset[i];
            }
        }
    }
    if (ik->flags & IK_ACCELERATES && !(mode & IK_FROM_REST)) {
        const real ratio = state[IK_LAST] > R(0.0) ? period / state[IK_LAST] : R(1.0);
        last = moved;
        for (int j = 0; j < n; j++) last[j] = ratio * dq[j];
    }
    ik_control(ik, q, x, J, used, mode & IK_HAS_FEED ? state + IK_FEED : NULL, period, last, &step);
    state[IK_LAST] = period;
    if (memory > R(0.0))
        for (int i = 0; i < 3; i++) offset[i] *= HK_MATH(exp)(-period / memory);
    state[IK_SIGMA_MIN] = step.sigma_min;
    state[IK_DAMPING] = step.damping;
    state[IK_DISTANCE] = ik_norm(3, error);
    for (int j = 0; j < n; j++) {
        before[j] = q[j];
        dq[j] = step.dq[j];
        held[j] = step.held[j];
        q[j] = q[j] + dq[j];
    }
}
