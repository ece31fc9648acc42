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

#include "nearest.h"

/* Shorten a step z to at most half of that of a task: else the way to a posture would go on shaking
   a robot that rests where its target is out of reach. */
static inline void ik_calm(int n, const real *task, real *z) {
    const real share = ik_norm(n, task) / (R(2.0) * ik_norm(n, z));
    for (int j = 0; j < n && share < R(1.0); j++) z[j] *= share;
}

/* Limits of a step beside its bounds: rows A (k, n) of any length with A dq <= b. */
typedef struct {
    int k;
    const real *A, *b;
} ik_rows_t;

/* The step within its limits whose task part does not depend on the preferred step z: near a
   singularity the damped task is solved for z = 0 first, then z chooses among the steps that move
   the tip so. `work`: IK_STRICT_WORK(n, m) numbers. */
#define IK_STRICT_WORK(n, m) (NEAR_WORK(n, m) + HK_MAX_N * (n))
static void ik_strict_step(int m, int n, const real *J, const real *g, const real *v,
                           const real *z, const real *lower, const real *upper,
                           const ik_rows_t *rows, real damping_sq, int calm, real *work,
                           real *dq) {
    real sum = R(0.0), moved[IK_MOST_ROWS], none[HK_MAX_N], slower[HK_MAX_N];
    real *A = work + NEAR_WORK(n, m), b[HK_MAX_N], most[HK_MAX_N];
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
