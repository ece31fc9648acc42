/* One step of inverse kinematics for a position: the damped inverse, a posture in its null space,
   and limits inside the step. One row at a time.

   The worst case is two stages of 1 + IK_PROXIMAL solutions in the box, each of IK_NEWTON steps,
   each of at most 2 n + 1 sums over the n actuators in its line search; a handful is usual. */

enum { IK_NEWTON = 60, IK_PROXIMAL = 2 };
#define IK_HEALTHY R(0.02) /* sigma_min / sigma_max above which no damping is needed */

enum { IK_LIMITED = 1, IK_POSTURE = 2, IK_WEIGHTS = 4, IK_ACCELERATES = 8 };

/* The settings: limits of q, of its speed and acceleration, posture, and units in which nothing has
   a weight. */
typedef struct {
    hk_plan plan;
    int model, n, flags;
    const real *low, *high, *speed, *accel, *posture, *unit;
    real gain, beta, dt, damping; /* gain < 0: 1 / dt; damping < 0: adaptive */
} ik_settings;

/* A step: its bounds and the posture step, which go in, and what comes out. */
typedef struct {
    real lower[HK_MAX_N], upper[HK_MAX_N], posture[HK_MAX_N];
    real dq[HK_MAX_N], sigma_min, damping;
    unsigned char held[HK_MAX_N];
} ik_step_t;

static inline ik_settings ik_settings_of(const int32_t *code, const real *data, int at) {
    const int32_t *node = code + at;
    const int n = node[HK_N];
    const real *a = data + node[HK_DATA], *b = a + 6 * n;
    const ik_settings ik = {{code, data}, node[HK_MORE], n, node[HK_MORE + 1], a, a + n, a + 2 * n,
                      a + 3 * n, a + 4 * n, a + 5 * n, b[0], b[1], b[2], b[3]};
    return ik;
}

static inline real ik_clip(real y, real lower, real upper) {
    y = y < lower ? lower : y;
    return y > upper ? upper : y;
}

static inline real ik_abs(real a) { return a < R(0.0) ? -a : a; }

static inline int ik_finite(int n, const real *a) {
    real sum = R(0.0);
    for (int j = 0; j < n; j++) sum += R(0.0) * a[j];
    return sum == R(0.0);
}

static inline real ik_norm(int n, const real *a) {
    real sum = R(0.0);
    for (int j = 0; j < n; j++) sum += a[j] * a[j];
    return HK_MATH(sqrt)(sum);
}

/* r (3) = J step. */
HK_INLINE void ik_rows_of(int n, const real *J, const real *step, real *r) {
    real a = R(0.0), b = R(0.0), c = R(0.0);
    for (int j = 0; j < n; j++) {
        a += J[j] * step[j];
        b += J[n + j] * step[j];
        c += J[2 * n + j] * step[j];
    }
    r[0] = a, r[1] = b, r[2] = c;
}

/* y (n) = z + J^T mu. */
HK_INLINE void ik_columns_of(int n, const real *J, const real *mu, const real *z, real *y) {
    for (int j = 0; j < n; j++)
        y[j] = z[j] + (J[j] * mu[0] + J[n + j] * mu[1] + J[2 * n + j] * mu[2]);
}

/* g = the entries 11, 21, 31, 22, 32, 33 of the sum over actuators of keep J J^T. */
HK_INLINE void ik_products(int n, const real *J, const real *keep, real *g) {
    for (int i = 0; i < 6; i++) g[i] = R(0.0);
    for (int j = 0; j < n; j++) {
        const real b = J[n + j], c = J[2 * n + j], k = keep ? keep[j] : R(1.0);
        const real ka = k * J[j], kb = k * b;
        g[0] += ka * J[j], g[1] += ka * b, g[2] += ka * c;
        g[3] += kb * b, g[4] += kb * c, g[5] += k * c * c;
    }
}

/* The singular values of J from g = J J^T, by the trigonometric solution of the cubic. */
static inline void ik_singular_values(const real *g, real *low, real *high) {
    const real mean = (g[0] + g[3] + g[5]) / R(3.0);
    const real a = g[0] - mean, b = g[3] - mean, c = g[5] - mean;
    const real off = g[1] * g[1] + g[2] * g[2] + g[4] * g[4];
    const real radius = HK_MATH(sqrt)((a * a + b * b + c * c + R(2.0) * off) / R(6.0));
    const real det = a * (b * c - g[4] * g[4]) - g[1] * (g[1] * c - g[4] * g[2]) +
                     g[2] * (g[1] * g[4] - b * g[2]);
    const real cube = radius * radius * radius;
    const real ratio = R(0.5) * det / (cube < HK_TINY ? HK_TINY : cube);
    const real angle = HK_MATH(acos)(ik_clip(ratio, R(-1.0), R(1.0))) / R(3.0);
    const real least = mean + R(2.0) * radius * HK_MATH(cos)(angle + R(2.0943951023931957));
    const real most = mean + R(2.0) * radius * HK_MATH(cos)(angle);
    *low = HK_MATH(sqrt)(least < R(0.0) ? R(0.0) : least);
    *high = HK_MATH(sqrt)(most < R(0.0) ? R(0.0) : most);
}

/* LDL^T of g + lambda^2 1. What depends on the rows before, to rounding, is dropped. */
typedef struct {
    real i1, i2, i3, l21, l31, l32;
} ik_factors;

static inline real ik_reciprocal(real pivot, real least) {
    return pivot > least ? R(1.0) / pivot : R(0.0);
}

static inline ik_factors ik_factor(const real *g, real damping_sq) {
    const real g11 = g[0] + damping_sq, g22 = g[3] + damping_sq, g33 = g[5] + damping_sq;
    const real least = R(8.0) * HK_EPS * (g11 + g22 + g33);
    ik_factors f;
    f.i1 = ik_reciprocal(g11, least);
    f.l21 = g[1] * f.i1, f.l31 = g[2] * f.i1;
    f.i2 = ik_reciprocal(g22 - f.l21 * g[1], least);
    const real t = g[4] - f.l31 * g[1];
    f.l32 = t * f.i2;
    f.i3 = ik_reciprocal(g33 - f.l31 * g[2] - f.l32 * t, least);
    return f;
}

static inline void ik_solve3(const ik_factors *f, const real *v, real *mu) {
    const real v2 = v[1] - f->l21 * v[0], v3 = v[2] - f->l31 * v[0] - f->l32 * v2;
    mu[2] = v3 * f->i3;
    mu[1] = v2 * f->i2 - f->l32 * mu[2];
    mu[0] = v[0] * f->i1 - f->l21 * mu[1] - f->l31 * mu[2];
}

/* step <- (1 - J+ J) step, undamped; twice, which takes the rounding out again. */
HK_INLINE void ik_null_projection(int n, const real *J, const real *g, real *step) {
    const ik_factors f = ik_factor(g, R(0.0));
    for (int twice = 0; twice < 2; twice++) {
        real moved[3], mu[3];
        ik_rows_of(n, J, step, moved);
        ik_solve3(&f, moved, mu);
        for (int i = 0; i < 3; i++) mu[i] = -mu[i];
        ik_columns_of(n, J, mu, step, step);
    }
}

/* t in (0, 1) where value(t) = start + t curvature + slope . (clip(y + t slope) - dq) is 0.

   It grows with t, is linear between the points where a coordinate meets a bound, negative at 0
   and positive (`end`) at 1. These points are halved until none is left between the two sides. */
HK_INLINE real ik_line_search(int n, const real *y, const real *dq, const real *slope,
                              const real *lower, const real *upper, real start, real curvature,
                              real end) {
    real points[2 * HK_MAX_N], t0 = R(0.0), t1 = R(1.0), f0 = start, f1 = end;
    int count = 0;
    for (int j = 0; j < n; j++) {
        const real a = (lower[j] - y[j]) / slope[j], b = (upper[j] - y[j]) / slope[j];
        points[count] = a;
        count += a > R(0.0) && a < R(1.0);
        points[count] = b;
        count += b > R(0.0) && b < R(1.0);
    }
    while (count > 0) {
        const real t = points[count / 2];
        real value = start + t * curvature;
        for (int j = 0; j < n; j++)
            value += slope[j] * (ik_clip(y[j] + t * slope[j], lower[j], upper[j]) - dq[j]);
        if (value > R(0.0))
            t1 = t, f1 = value;
        else
            t0 = t, f0 = value;
        int left = 0;
        for (int i = 0; i < count; i++) {
            const real a = points[i];
            points[left] = a;
            left += a > t0 && a < t1;
        }
        count = left;
    }
    return t0 + (t1 - t0) * (f0 < f1 ? ik_clip(f0 / (f0 - f1), R(0.0), R(1.0)) : R(1.0));
}

/* The minimiser dq of |dq - z|^2 + |J dq - v|^2 / lambda^2 in the box, and its multipliers mu.

   dq(mu) = clip(z + J^T mu) with F(mu) = J dq(mu) + lambda^2 mu - v = 0: Newton's method on the
   active pieces with an exact line search; `mu` holds its start. */
HK_INLINE void ik_box_of(int n, const real *J, const real *v, const real *z, const real *lower,
                         const real *upper, real damping_sq, real *mu, real *dq) {
    real y[HK_MAX_N], slope[HK_MAX_N], free[HK_MAX_N];
    int settled = 0;
    for (int round = 0;; round++) {
        real residual[3] = {R(0.0), R(0.0), R(0.0)}, scale[3] = {R(0.0), R(0.0), R(0.0)};
        real newton[3], g[6];
        ik_columns_of(n, J, mu, z, y);
        for (int j = 0; j < n; j++) dq[j] = ik_clip(y[j], lower[j], upper[j]);
        if (settled || round == IK_NEWTON) return;
        int going = 0;
        for (int j = 0; j < n; j++)
            for (int i = 0; i < 3; i++) {
                const real part = J[n * i + j] * dq[j];
                residual[i] += part, scale[i] += ik_abs(part);
            }
        for (int i = 0; i < 3; i++) {
            const real pull = damping_sq * mu[i];
            residual[i] += pull - v[i], scale[i] += ik_abs(pull) + ik_abs(v[i]);
            going |= ik_abs(residual[i]) > R(4.0) * HK_EPS * scale[i];
        }
        if (!going) return;
        for (int j = 0; j < n; j++)
            free[j] = y[j] > lower[j] && y[j] < upper[j] ? R(1.0) : R(0.0);
        ik_products(n, J, free, g);
        const ik_factors f = ik_factor(g, damping_sq);
        ik_solve3(&f, residual, newton);
        real start = R(0.0), curvature = R(0.0);
        for (int i = 0; i < 3; i++) {
            newton[i] = -newton[i];
            start += newton[i] * residual[i];
            curvature += damping_sq * newton[i] * newton[i];
        }
        /* A full step that stays on its linear piece has solved it, and with it the problem. */
        real end = start + curvature, length = R(1.0);
        settled = 1;
        for (int j = 0; j < n; j++) {
            slope[j] = J[j] * newton[0] + J[n + j] * newton[1] + J[2 * n + j] * newton[2];
            const real full = y[j] + slope[j];
            settled &= (((full > lower[j]) == (y[j] > lower[j])) &
                        ((full < upper[j]) == (y[j] < upper[j]))) | (lower[j] == upper[j]);
            end += slope[j] * (ik_clip(full, lower[j], upper[j]) - dq[j]);
        }
        if (end > R(0.0) && !settled)
            length = ik_line_search(n, y, dq, slope, lower, upper, start, curvature, end);
        for (int i = 0; i < 3; i++) mu[i] += length * newton[i];
    }
}

static void ik_box(int n, const real *J, const real *v, const real *z, const real *lower,
                   const real *upper, real damping_sq, real *mu, real *dq) {
    switch (HK_COMMON(n)) { /* loops of known length */
    case 6: ik_box_of(6, J, v, z, lower, upper, damping_sq, mu, dq); break;
    case 9: ik_box_of(9, J, v, z, lower, upper, damping_sq, mu, dq); break;
    default: ik_box_of(n, J, v, z, lower, upper, damping_sq, mu, dq);
    }
}

/* `ik_box` for any lambda^2 >= 0. It is solved with at least the floor; rounds on the multipliers
   take out what is too much. */
static void ik_proximal_box(int n, const real *J, const real *v, const real *z, const real *lower,
                            const real *upper, real damping_sq, real least, real *mu, real *dq) {
    const real used = damping_sq < least ? least : damping_sq, excess = used - damping_sq;
    for (int round = 0; round <= IK_PROXIMAL; round++) {
        real wanted[3];
        for (int i = 0; i < 3; i++) wanted[i] = v[i] + excess * mu[i];
        ik_box(n, J, wanted, z, lower, upper, used, mu, dq);
        if (excess == R(0.0)) return;
    }
}

/* The step in the box whose task part does not depend on the preferred step z: near a singularity
   the damped task is solved for z = 0 first, then z chooses among the steps that move the tip so. */
static void ik_strict_box(int n, const real *J, const real *g, const real *v, const real *z,
                          const real *lower, const real *upper, real damping_sq, real *dq) {
    const real off = g[1] * g[1] + g[2] * g[2] + g[4] * g[4];
    const real size_sq =
        HK_MATH(sqrt)(g[0] * g[0] + g[3] * g[3] + g[5] * g[5] + R(2.0) * off);
    const real rounding = HK_MATH(sqrt)(HK_EPS), relative = rounding > R(1e-6) ? rounding : R(1e-6);
    const real least = size_sq > R(0.0) ? relative * size_sq : R(1.0);
    real mu[3] = {R(0.0), R(0.0), R(0.0)}, moved[3], none[HK_MAX_N];
    int preferred = 0;
    for (int j = 0; j < n; j++) {
        none[j] = R(0.0);
        preferred |= z[j] != R(0.0);
    }
    if (damping_sq > R(0.0) && preferred) {
        ik_proximal_box(n, J, v, none, lower, upper, damping_sq, least, mu, dq);
        ik_rows_of(n, J, dq, moved);
        v = moved, damping_sq = R(0.0);
    }
    ik_proximal_box(n, J, v, z, lower, upper, damping_sq, least, mu, dq);
}

/* lambda^2, zero for a healthy J and growing smoothly from there (Nakamura & Hanafusa, 1986). */
static inline real ik_damping_sq(const ik_settings *ik, real low, real high) {
    if (ik->damping >= R(0.0)) return ik->damping * high * (ik->damping * high);
    const real bound = IK_HEALTHY * high, ratio = low / (bound > R(0.0) ? bound : R(1.0));
    const real lack = R(1.0) - ratio * ratio, lambda = bound * (lack < R(0.0) ? R(0.0) : lack);
    return lambda * lambda;
}

/* Fill in a step for the task v within its bounds; `slides`: with its posture step. `trust` is
   lambda^2 / sigma_max^2 in place of the settings' damping, NULL where that counts. */
HK_INLINE void ik_limited_step_of(int n, const ik_settings *ik, const real *J, const real *v, int slides,
                                  const real *trust, ik_step_t *s) {
    real own[5 * HK_MAX_N], z[HK_MAX_N], mu[3], g[6], low = R(0.0), high, damping_sq, *dq = s->dq;
    const real *lower = s->lower, *upper = s->upper;
    for (int j = 0; j < n; j++) z[j] = slides ? s->posture[j] : R(0.0);
    if (ik->flags & IK_WEIGHTS) {
        for (int j = 0; j < n; j++) {
            for (int i = 0; i < 3; i++) own[n * i + j] = J[n * i + j] * ik->unit[j];
            own[3 * n + j] = lower[j] / ik->unit[j];
            own[4 * n + j] = upper[j] / ik->unit[j];
            z[j] = z[j] / ik->unit[j];
        }
        J = own, lower = own + 3 * n, upper = own + 4 * n;
    }
    ik_products(n, J, NULL, g);
    if (trust)
        damping_sq = *trust * (g[0] + g[3] + g[5]);
    else {
        ik_singular_values(g, &low, &high);
        damping_sq = ik_damping_sq(ik, low, high);
    }
    const ik_factors f = ik_factor(g, damping_sq);
    ik_solve3(&f, v, mu);
    if (slides) ik_null_projection(n, J, g, z);
    ik_columns_of(n, J, mu, z, dq);
    if (ik->flags & IK_LIMITED) {
        int over = 0;
        for (int j = 0; j < n; j++) over |= ik_clip(dq[j], lower[j], upper[j]) != dq[j];
        if (over) ik_strict_box(n, J, g, v, z, lower, upper, damping_sq, dq);
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
    switch (HK_COMMON(ik->n)) {
    case 6: ik_limited_step_of(6, ik, J, v, slides, trust, s); break;
    case 9: ik_limited_step_of(9, ik, J, v, slides, trust, s); break;
    default: ik_limited_step_of(ik->n, ik, J, v, slides, trust, s);
    }
}

/* The largest first step from which steps that shrink by `change` stop within `way`. */
static inline real ik_stopping(real way, real change) {
    const real ahead = way > R(0.0) ? way : R(0.0);
    if (!(ahead < R(INFINITY))) return way;
    return R(2.0) * way / (R(1.0) + HK_MATH(sqrt)(R(1.0) + R(2.0) * ahead / change));
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

/* No faster towards the target, and the posture, than the actuators can brake in time: shorten the
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

/* Eq. (1) for one period from q: the error e and the motion `feed` of the target (may be NULL) are
   taken back. What is not finite holds still, with a limit of acceleration after it has braked. */
static HK_NOINLINE void ik_control(const ik_settings *ik, const real *q, const real *J,
                                   const real *e, const real *feed, real seconds,
                                   const real *last, ik_step_t *s) {
    const int n = ik->n;
    real v[3], gain = ik->gain < R(0.0) ? R(1.0) : ik->gain * seconds, beta = ik->beta * seconds;
    gain = gain > R(1.0) ? R(1.0) : gain;
    beta = beta > R(1.0) ? R(1.0) : beta;
    for (int i = 0; i < 3; i++) v[i] = gain * e[i] + (feed ? feed[i] : R(0.0));
    const int known = !last || ik_finite(n, last);
    if (known && ik_finite(n, q) && ik_finite(3 * n, J) && ik_finite(3, v)) {
        for (int j = 0; j < n; j++) s->posture[j] = beta * (ik->posture[j] - q[j]);
        if (ik->flags & IK_ACCELERATES) {
            const real share = ik_brake(ik, q, J, e, seconds, s);
            for (int i = 0; i < 3; i++)
                v[i] = (share < gain ? share : gain) * e[i] + (feed ? feed[i] : R(0.0));
        }
        ik_step_bounds(ik, q, seconds, last, s);
        ik_limited_step(ik, J, v, ik->flags & IK_POSTURE, NULL, s);
        return;
    }
    const real still[3 * HK_MAX_N] = {R(0.0)};
    ik_step_bounds(ik, q, seconds, known ? last : NULL, s);
    ik_limited_step(ik, still, still, 0, NULL, s);
    for (int j = 0; j < n; j++) s->dq[j] = q[j] == q[j] ? s->dq[j] : R(0.0);
    s->sigma_min = R(NAN);
}

/* The model at one configuration. Every step and tick calls this one, and gets the same bits; who
   includes this file writes it. */
static void ik_model(const ik_settings *ik, const real *q, real *x, real *J, real *distance);

/* The state of a robot that follows targets, one array: what goes in, what comes out, and what is
   kept from tick to tick, the offset of the measured tip, q and dq. */
enum {
    IK_MODE, /* sum of the last five below */
    IK_PERIOD,
    IK_MEMORY, /* seconds, 0 for none */
    IK_LAST, /* period of the tick before, 0 for none */
    IK_SIGMA_MIN,
    IK_DAMPING,
    IK_DISTANCE, /* of the error */
    IK_TARGET,
    IK_FEED = IK_TARGET + 3, /* motion of the target in this period */
    IK_TIP = IK_FEED + 3,
    IK_OFFSET = IK_TIP + 3,
    IK_X = IK_OFFSET + 3,
    IK_ERROR = IK_X + 3,
    IK_Q = IK_ERROR + 3, /* then dq, q before, whether it was held (n each), and J (3 n) */
    IK_STATE = IK_Q + 7 * HK_MAX_N
};
enum { IK_HAS_TARGET = 1, IK_HAS_FEED = 2, IK_HAS_TIP = 4, IK_MUST_SEE = 8, IK_FROM_REST = 16 };

static inline void ik_tick(const ik_settings *ik, real *state) {
    const int n = ik->n, mode = (int)state[IK_MODE];
    const real *target = state + IK_TARGET, *tip = state + IK_TIP, period = state[IK_PERIOD];
    real *q = state + IK_Q, *dq = q + n, *before = q + 2 * n, *held = q + 3 * n, *J = q + 4 * n;
    real *x = state + IK_X, *error = state + IK_ERROR, *offset = state + IK_OFFSET;
    const real memory = state[IK_MEMORY];
    real used[3] = {R(0.0), R(0.0), R(0.0)}, *last = NULL, moved[HK_MAX_N];
    ik_step_t step;
    ik_model(ik, q, x, J, NULL);
    for (int i = 0; i < 3; i++) error[i] = R(NAN);
    if (mode & IK_HAS_TARGET) {
        real apart[3];
        for (int i = 0; i < 3; i++) {
            used[i] = target[i] - x[i];
            error[i] = mode & IK_HAS_TIP ? target[i] - tip[i] : used[i];
            apart[i] = used[i] - error[i];
        }
        if (mode & IK_HAS_TIP) {
            /* Without a reading the model's error counts, moved by the offset that is remembered;
               without memory no error counts. */
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
    ik_control(ik, q, J, used, mode & IK_HAS_FEED ? state + IK_FEED : NULL, period, last, &step);
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
