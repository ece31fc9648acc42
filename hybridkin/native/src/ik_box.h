/* Damped solves and projections for m task rows, and steps within limits: one row at a time. */

#ifdef HK_KINDS /* code for one task */
#define IK_OF(m, f, ...) ((m) == HK_MAX_R ? f(HK_MAX_R, __VA_ARGS__) : f(m, __VA_ARGS__))
#else
#define IK_OF(m, f, ...)                                                                           \
    ((m) == 3 ? f(3, __VA_ARGS__) : (m) == 6 ? f(6, __VA_ARGS__) : f(m, __VA_ARGS__))
#endif
enum {
    IK_ROWS = HK_MAX_R,
    IK_PAIRS = IK_ROWS * (IK_ROWS + 1) / 2,
    IK_MOST_ROWS = IK_ROWS + IK_NORMALS, /* with the normals of a plane */
    IK_MOST_PAIRS = IK_MOST_ROWS * (IK_MOST_ROWS + 1) / 2
};

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

/* r (m) = J step. */
HK_INLINE void ik_rows_of(int m, int n, const real *J, const real *step, real *r) {
    real sum[IK_MOST_ROWS];
    for (int i = 0; i < m; i++) sum[i] = R(0.0);
    for (int j = 0; j < n; j++)
        for (int i = 0; i < m; i++) sum[i] += J[n * i + j] * step[j];
    for (int i = 0; i < m; i++) r[i] = sum[i];
}

/* y (n) = z + J^T mu. */
HK_INLINE void ik_columns_of(int m, int n, const real *J, const real *mu, const real *z, real *y) {
    for (int j = 0; j < n; j++) {
        real sum = J[j] * mu[0];
        for (int i = 1; i < m; i++) sum += J[n * i + j] * mu[i];
        y[j] = z[j] + sum;
    }
}

/* g = the columns of the lower half of the sum over actuators of keep J J^T, one after another. */
HK_INLINE void ik_products(int m, int n, const real *J, const real *keep, real *g) {
    real sum[IK_MOST_PAIRS];
    for (int i = 0; i < m * (m + 1) / 2; i++) sum[i] = R(0.0);
    for (int j = 0; j < n; j++)
        for (int k = 0, at = 0; k < m; k++) {
            const real a = keep ? keep[j] * J[n * k + j] : J[n * k + j];
            for (int i = k; i < m; i++) sum[at++] += a * J[n * i + j];
        }
    for (int i = 0; i < m * (m + 1) / 2; i++) g[i] = sum[i];
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

/* LDL^T of g + lambda^2 1, and 1 / D. What depends on the rows before, to rounding, is dropped. */
typedef struct {
    real l[IK_MOST_ROWS][IK_MOST_ROWS], inverse[IK_MOST_ROWS];
} ik_factors;

HK_INLINE real ik_trace(int m, const real *g) {
    real sum = R(0.0);
    for (int k = 0, at = 0; k < m; at += m - k++) sum += g[at];
    return sum;
}

HK_INLINE void ik_factor(int m, const real *g, real damping_sq, ik_factors *f) {
    const real least = R(8.0) * HK_EPS * (ik_trace(m, g) + (real)m * damping_sq);
    real scaled[IK_MOST_ROWS][IK_MOST_ROWS];
    for (int k = 0, at = 0; k < m; k++)
        for (int i = k; i < m; i++) {
            real t = i == k ? g[at++] + damping_sq : g[at++];
            for (int p = 0; p < k; p++) t -= f->l[i][p] * scaled[k][p];
            scaled[i][k] = t;
            if (i == k) f->inverse[k] = t > least ? R(1.0) / t : R(0.0);
            f->l[i][k] = t * f->inverse[k];
        }
}

/* Estimates of the least and the largest singular value of J from the pivots of g. */
HK_INLINE void ik_pivots(int m, const real *g, real *low, real *high) {
    ik_factors f;
    ik_factor(m, g, R(0.0), &f);
    real least = ik_trace(m, g);
    *high = HK_MATH(sqrt)(least);
    for (int k = 0; k < m; k++) {
        const real pivot = f.inverse[k] > R(0.0) ? R(1.0) / f.inverse[k] : R(0.0);
        least = pivot < least ? pivot : least;
    }
    *low = HK_MATH(sqrt)(least);
}

HK_INLINE void ik_solve(int m, const ik_factors *f, const real *v, real *mu) {
    real w[IK_MOST_ROWS];
    for (int i = 0; i < m; i++) {
        w[i] = v[i];
        for (int p = 0; p < i; p++) w[i] -= f->l[i][p] * w[p];
    }
    for (int i = m - 1; i >= 0; i--) {
        mu[i] = w[i] * f->inverse[i];
        for (int p = i + 1; p < m; p++) mu[i] -= f->l[p][i] * mu[p];
    }
}

/* The eigenvalues of a symmetric matrix g (m, m), and its eigenvectors as columns. */
typedef struct {
    real square[IK_ROWS], vectors[IK_ROWS][IK_ROWS];
} ik_eigen;

/* Jacobi's method: turn two axes at a time until all products of two axes are rounding. */
HK_INLINE void ik_eigen_of(int m, const real *g, ik_eigen *e) {
    real a[IK_ROWS][IK_ROWS];
    const real trace = ik_trace(m, g);
    e->square[0] = R(0.0); /* compilers do not see that m > 0 */
    for (int k = 0, at = 0; k < m; k++)
        for (int i = k; i < m; i++) {
            a[i][k] = a[k][i] = g[at++];
            e->vectors[i][k] = e->vectors[k][i] = i == k ? R(1.0) : R(0.0);
        }
    for (int sweep = 0, going = 1; sweep < IK_SWEEPS && going; sweep++) {
        going = 0;
        for (int k = 0; k < m; k++)
            for (int i = k + 1; i < m; i++) {
                if (!(ik_abs(a[i][k]) > R(0.25) * HK_EPS * trace)) continue;
                const real ratio = R(0.5) * (a[i][i] - a[k][k]) / a[i][k];
                const real root = HK_MATH(sqrt)(R(1.0) + ratio * ratio);
                const real t = ratio < R(0.0) ? R(1.0) / (ratio - root) : R(1.0) / (ratio + root);
                const real c = R(1.0) / HK_MATH(sqrt)(R(1.0) + t * t), s = t * c;
                going = 1;
                for (int j = 0; j < m; j++) {
                    const real x = a[k][j], y = a[i][j];
                    a[k][j] = c * x - s * y;
                    a[i][j] = s * x + c * y;
                }
                for (int j = 0; j < m; j++) {
                    const real x = a[j][k], y = a[j][i], v = e->vectors[k][j], w = e->vectors[i][j];
                    a[j][k] = c * x - s * y;
                    a[j][i] = s * x + c * y;
                    e->vectors[k][j] = c * v - s * w;
                    e->vectors[i][j] = s * v + c * w;
                }
            }
    }
    for (int i = 0; i < m; i++) e->square[i] = a[i][i];
}

/* mu with (g + lambda^2 1) mu = v; what depends on other rows, to rounding, is dropped. */
HK_INLINE void ik_eigen_solve(int m, const ik_eigen *e, const real *v, real damping_sq, real *mu) {
    real sum = R(0.0), along[IK_ROWS];
    for (int i = 0; i < m; i++) sum += e->square[i] > R(0.0) ? e->square[i] : R(0.0);
    for (int i = 0; i < m; i++) {
        const real square = e->square[i] + damping_sq;
        along[i] = R(0.0);
        for (int j = 0; j < m; j++) along[i] += e->vectors[i][j] * v[j];
        along[i] = square > R(8.0) * HK_EPS * sum ? along[i] / square : R(0.0);
    }
    for (int j = 0; j < m; j++) {
        mu[j] = R(0.0);
        for (int i = 0; i < m; i++) mu[j] += e->vectors[i][j] * along[i];
    }
}

/* The singular values of J from the eigenvalues of J J^T, without the `n_free` smallest ones. */
HK_INLINE void ik_eigen_ends(int m, int n_free, const ik_eigen *e, real *low, real *high) {
    real least = e->square[0], most = e->square[0];
    for (int i = 1; i < m; i++) {
        least = e->square[i] < least ? e->square[i] : least;
        most = e->square[i] > most ? e->square[i] : most;
    }
    for (int i = 0; n_free > 0 && i < m; i++) {
        int smaller = 0;
        for (int j = 0; j < m; j++)
            smaller += e->square[j] < e->square[i] || (j < i && e->square[j] == e->square[i]);
        if (smaller == n_free) least = e->square[i];
    }
    *low = HK_MATH(sqrt)(least < R(0.0) ? R(0.0) : least);
    *high = HK_MATH(sqrt)(most < R(0.0) ? R(0.0) : most);
}

/* step <- (1 - J+ J) step by the eigenvectors, as `ik_null_projection`. */
HK_INLINE void ik_eigen_projection(int m, int n, const real *J, const ik_eigen *e, real *step) {
    for (int twice = 0; twice < 2; twice++) {
        real moved[IK_ROWS], mu[IK_ROWS];
        ik_rows_of(m, n, J, step, moved);
        ik_eigen_solve(m, e, moved, R(0.0), mu);
        for (int i = 0; i < m; i++) mu[i] = -mu[i];
        ik_columns_of(m, n, J, mu, step, step);
    }
}

/* step <- (1 - J+ J) step, undamped; twice, which takes the rounding out again. */
HK_INLINE void ik_null_projection(int m, int n, const real *J, const real *g, real *step) {
    ik_factors f;
    ik_factor(m, g, R(0.0), &f);
    for (int twice = 0; twice < 2; twice++) {
        real moved[IK_MOST_ROWS], mu[IK_MOST_ROWS];
        ik_rows_of(m, n, J, step, moved);
        ik_solve(m, &f, moved, mu);
        for (int i = 0; i < m; i++) mu[i] = -mu[i];
        ik_columns_of(m, n, J, mu, step, step);
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
HK_INLINE void ik_box_of(int m, int n, const real *J, const real *v, const real *z,
                         const real *lower, const real *upper, real damping_sq, real *mu,
                         real *dq) {
    real y[HK_MAX_N], slope[HK_MAX_N], free[HK_MAX_N];
    int settled = 0;
    for (int round = 0;; round++) {
        real residual[IK_MOST_ROWS] = {R(0.0)}, scale[IK_MOST_ROWS] = {R(0.0)};
        real newton[IK_MOST_ROWS], g[IK_MOST_PAIRS];
        ik_columns_of(m, n, J, mu, z, y);
        for (int j = 0; j < n; j++) dq[j] = ik_clip(y[j], lower[j], upper[j]);
        if (settled || round == IK_NEWTON) return;
        int going = 0;
        for (int j = 0; j < n; j++)
            for (int i = 0; i < m; i++) {
                const real part = J[n * i + j] * dq[j];
                residual[i] += part, scale[i] += ik_abs(part);
            }
        for (int i = 0; i < m; i++) {
            const real pull = damping_sq * mu[i];
            residual[i] += pull - v[i], scale[i] += ik_abs(pull) + ik_abs(v[i]);
            going |= ik_abs(residual[i]) > R(4.0) * HK_EPS * scale[i];
        }
        if (!going) return;
        for (int j = 0; j < n; j++) free[j] = y[j] > lower[j] && y[j] < upper[j] ? R(1.0) : R(0.0);
        ik_products(m, n, J, free, g);
        ik_factors f;
        ik_factor(m, g, damping_sq, &f);
        ik_solve(m, &f, residual, newton);
        real start = R(0.0), curvature = R(0.0);
        for (int i = 0; i < m; i++) {
            newton[i] = -newton[i];
            start += newton[i] * residual[i];
            curvature += damping_sq * newton[i] * newton[i];
        }
        /* A full step that stays on its linear piece has solved the problem. */
        real end = start + curvature, length = R(1.0);
        settled = 1;
        for (int j = 0; j < n; j++) slope[j] = R(0.0);
        ik_columns_of(m, n, J, newton, slope, slope);
        for (int j = 0; j < n; j++) {
            const real full = y[j] + slope[j];
            settled &= (((full > lower[j]) == (y[j] > lower[j])) &
                        ((full < upper[j]) == (y[j] < upper[j]))) |
                       (lower[j] == upper[j]);
            end += slope[j] * (ik_clip(full, lower[j], upper[j]) - dq[j]);
        }
        if (end > R(0.0) && !settled)
            length = ik_line_search(n, y, dq, slope, lower, upper, start, curvature, end);
        for (int i = 0; i < m; i++) mu[i] += length * newton[i];
    }
}

static void ik_box(int m, int n, const real *J, const real *v, const real *z, const real *lower,
                   const real *upper, real damping_sq, real *mu, real *dq) {
    switch (HK_COMMON(100 * m + n)) { /* loops of known length */
    case 306: ik_box_of(3, 6, J, v, z, lower, upper, damping_sq, mu, dq); break;
    case 309: ik_box_of(3, 9, J, v, z, lower, upper, damping_sq, mu, dq); break;
    case 606: ik_box_of(6, 6, J, v, z, lower, upper, damping_sq, mu, dq); break;
    default: IK_OF(m, ik_box_of, n, J, v, z, lower, upper, damping_sq, mu, dq);
    }
}

/* `ik_box` for any lambda^2 >= 0. It is solved with at least the floor; rounds on the multipliers
   take out what is too much. */
static void ik_proximal_box(int m, int n, const real *J, const real *v, const real *z,
                            const real *lower, const real *upper, real damping_sq, real least,
                            real *mu, real *dq) {
    const real used = damping_sq < least ? least : damping_sq, excess = used - damping_sq;
    for (int round = 0; round <= IK_PROXIMAL; round++) {
        real wanted[IK_MOST_ROWS];
        for (int i = 0; i < m; i++) wanted[i] = v[i] + excess * mu[i];
        ik_box(m, n, J, wanted, z, lower, upper, used, mu, dq);
        if (excess == R(0.0)) return;
    }
}

#include "nearest.h"

/* Shorten a step z to at most half of that of a task: else the way to a posture would go on shaking
   a robot that rests where its target is out of reach. */
static inline void ik_calm(int n, const real *task, real *z) {
    const real share = ik_norm(n, task) / (R(2.0) * ik_norm(n, z));
    for (int j = 0; j < n && share < R(1.0); j++) z[j] *= share;
}

/* Limits of a step beside its bounds: rows A (k, n) of any length with A dq <= b, the most important
   ones first. */
typedef struct {
    int k;
    const real *A, *b;
} ik_rows_t;

static const ik_rows_t ik_no_rows = {0, NULL, NULL};

/* Whether there can be any, and how many at most: of half-spaces, and of obstacles. */
#define HK_LIMITS (HK_SPACES || HK_OBSTACLES)
enum { IK_MOST_LIMITS = HK_SPACES * HK_MAX_N + HK_OBSTACLES * IK_PAIRS_MOST + !HK_LIMITS };

/* The step within its limits whose task part does not depend on the preferred step z: near a
   singularity the damped task is solved for z = 0 first, then z chooses among the steps that move
   the tip so. `work`: IK_STRICT_WORK(n, m) numbers. */
#define IK_STRICT_WORK(n, m) (NEAR_WORK(n, m) + IK_MOST_LIMITS * (n))
static void ik_strict_step(int m, int n, const real *J, const real *g, const real *v,
                           const real *z, const real *lower, const real *upper,
                           const ik_rows_t *rows, real damping_sq, int calm, real *work,
                           real *dq) {
    real sum = R(0.0), moved[IK_MOST_ROWS], none[HK_MAX_N], slower[HK_MAX_N];
    real *A = work + NEAR_WORK(n, m), b[IK_MOST_LIMITS], most[IK_MOST_LIMITS];
    real mu[IK_MOST_ROWS] = {R(0.0)};
    int preferred = 0;
    for (int k = 0, at = 0; k < m; k++)
        for (int i = k; i < m; i++, at++) sum += (i == k ? g[at] : R(2.0) * g[at]) * g[at];
    const real size = HK_MATH(sqrt)(HK_MATH(sqrt)(sum));
    const real root = HK_MATH(sqrt)(HK_MATH(sqrt)(HK_EPS)), relative = root > R(1e-3) ? root : R(1e-3);
    const real least = size > R(0.0) ? relative * size : R(1.0);
    for (int j = 0; j < n; j++) {
        none[j] = R(0.0), slower[j] = z[j];
        preferred |= z[j] != R(0.0);
    }
    for (int i = 0; i < rows->k; i++) {
        const real length = ik_norm(n, rows->A + n * i), unit = length > R(0.0) ? length : R(1.0);
        most[i] = R(0.0); /* at rest, or at the hardest braking */
        for (int j = 0; j < n; j++) {
            A[n * i + j] = rows->A[n * i + j] / unit;
            most[i] += A[n * i + j] * ik_clip(R(0.0), lower[j], upper[j]);
        }
        most[i] = most[i] > rows->b[i] / unit ? most[i] : rows->b[i] / unit;
    }
    near_problem p = {n, m, rows->k, J, v, z, lower, upper, A, b, most, R(0.0), R(0.0), mu, work};
    for (int stage = damping_sq > R(0.0) && preferred ? 0 : 1; stage < 2; stage++) {
        for (int i = 0; i < rows->k; i++) {
            const real length = ik_norm(n, rows->A + n * i);
            b[i] = rows->b[i] / (length > R(0.0) ? length : R(1.0));
        }
        const real damping = HK_MATH(sqrt)(damping_sq);
        p.damping = damping > least ? damping : least;
        p.excess = damping > least ? R(0.0) : least * least - damping_sq;
        p.z = stage == 0 ? none : slower;
        ik_nearest(&p, dq);
        if (stage == 1) return;
        ik_rows_of(m, n, J, dq, moved);
        if (calm) ik_calm(n, dq, slower);
        p.v = moved, damping_sq = R(0.0); /* mu keeps the active limits, also out of reach */
    }
}

/* The step in the box whose task part does not depend on the preferred step z: near a singularity
   the damped task is solved for z = 0 first, then z chooses among the steps that move the tip so.
 */
static void ik_strict_box(int m, int n, const real *J, const real *g, const real *v, const real *z,
                          const real *lower, const real *upper, real damping_sq, int calm,
                          real *dq) {
    real sum = R(0.0);
    for (int k = 0, at = 0; k < m; k++)
        for (int i = k; i < m; i++, at++) sum += (i == k ? g[at] : R(2.0) * g[at]) * g[at];
    const real size_sq = HK_MATH(sqrt)(sum);
    const real rounding = HK_MATH(sqrt)(HK_EPS), relative = rounding > R(1e-6) ? rounding : R(1e-6);
    const real least = size_sq > R(0.0) ? relative * size_sq : R(1.0);
    real mu[IK_MOST_ROWS] = {R(0.0)}, moved[IK_MOST_ROWS], none[HK_MAX_N], slower[HK_MAX_N];
    int preferred = 0;
    for (int j = 0; j < n; j++) {
        none[j] = R(0.0), slower[j] = z[j];
        preferred |= z[j] != R(0.0);
    }
    if (damping_sq > R(0.0) && preferred) {
        ik_proximal_box(m, n, J, v, none, lower, upper, damping_sq, least, mu, dq);
        ik_rows_of(m, n, J, dq, moved);
        if (calm) ik_calm(n, dq, slower);
        v = moved, z = slower, damping_sq = R(0.0);
    }
    ik_proximal_box(m, n, J, v, z, lower, upper, damping_sq, least, mu, dq);
}

/* Whether a step goes beyond a row, by more than rounding. */
static inline int ik_breaks(int n, const ik_rows_t *rows, const real *dq) {
    for (int i = 0; i < rows->k; i++) {
        real beyond = -rows->b[i], size = ik_abs(rows->b[i]);
        for (int j = 0; j < n; j++) {
            const real part = rows->A[n * i + j] * dq[j];
            beyond += part, size += ik_abs(part);
        }
        if (beyond > R(8.0) * HK_EPS * size) return 1;
    }
    return 0;
}

/* The step within its limits: in its box, where no row is in its way, else the nearest one of all. */
static HK_NOINLINE void ik_within(int m, int n, const real *J, const real *g, const real *v,
                                  const real *z, const real *lower, const real *upper,
                                  const ik_rows_t *rows, real damping_sq, int calm, real *work,
                                  real *dq) {
    ik_strict_box(m, n, J, g, v, z, lower, upper, damping_sq, calm, dq);
    if (HK_LIMITS && ik_breaks(n, rows, dq))
        ik_strict_step(m, n, J, g, v, z, lower, upper, rows, damping_sq, calm, work, dq);
}
