/* One step of inverse kinematics, for a task of m rows: a position (3), several points, or a pose
   or a position with an axis (6). The damped inverse, a posture in its null space, and limits inside the step. One row at a
   time. */

#include "hysteresis.h"
#include "ik_box.h"

/* The settings: limits of q, of its speed and acceleration, posture, and units in which nothing has
   a weight. */
typedef struct {
    hk_plan plan;
    real *work;  /* memory of a call */
    real *slots; /* matrices as large as J with the normals of a plane, see `ik_slot` */
    int model, n, m, width, flags; /* width: numbers of a target */
    int n_normals, n_spaces;       /* of the plane to keep to; half-spaces of the tip */
    int quick;                     /* estimates of singular values suffice */
    int n_free;                    /* directions of the rows that no motion changes */
    const real *low, *high, *speed, *accel, *posture, *unit, *period, *pulls, *normals;
    const real *scale;             /* of every row of the task [m per unit] */
    const real *expected;          /* innovations of the rows; see feedback.h */
    real most, fraction;           /* the largest possible size of one, and how much is taken */
    const real *axis;              /* (3) of the tip that is steered */
    const real *spaces, *offsets;  /* normals (m, n_spaces), and how far along them */
#if HK_OBSTACLES
    int n_obstacles;
    const int32_t *body;           /* entries of its node: points that keep clear of obstacles, */
    const real *keep;              /* distances: of points, of pairs of them that can meet, along the
                                      body up to points [m]; then the place of its base */
    const real *scene;             /* the obstacles, where they are now */
#endif
    hk_hysteresis hysteresis;
    real gain, beta, dt, damping;  /* gain < 0: 1 / dt; damping < 0: adaptive */
    real least;                    /* lambda^2 at least, in the unit where nothing has a weight */
} ik_settings;

/* What the matrices are for; of the ends of a step there are three. */
enum { IK_WEIGHTED, IK_IN_PLANE, IK_TAUT, IK_WISHED, IK_END, IK_SLOTS = IK_END + 3 };

/* Numbers of these matrices. */
#define IK_SLOTS_WORK(n, m, normals, points, pairs)                                                \
    (IK_SLOTS * (n) * ((m) + (normals)) +                                                          \
     HK_LIMITS * (IK_STRICT_WORK(n, (m) + (normals)) + IK_MOST_LIMITS * (n)) +                     \
     HK_OBSTACLES * IK_NEAR_WORK(n, points, pairs))
#define IK_NEAR_WORK(n, points, pairs) ((9 + 3 * (n)) * (points) + 6 * (pairs))

/* Pairs of a point of a body and an obstacle, or of two points that can meet. */
#define IK_PAIRS_OF(body, n_obstacles)                                                             \
    ((body)[IK_N_POINTS] * (n_obstacles) + (body)[IK_N_MEETING])

static inline real *ik_slot(const ik_settings *ik, int which) {
    return ik->slots + which * ik->n * (ik->m + ik->n_normals);
}

/* Memory of a step within limits, and rows (k, n) of these. */
static inline real *ik_strict_memory(const ik_settings *ik) { return ik_slot(ik, IK_SLOTS); }
static inline real *ik_rows_memory(const ik_settings *ik) {
    return ik_slot(ik, IK_SLOTS) + IK_STRICT_WORK(ik->n, ik->m + ik->n_normals);
}

/* Memory for what is near the body. */
static inline real *ik_near_memory(const ik_settings *ik) {
    return ik_rows_memory(ik) + IK_MOST_LIMITS * ik->n;
}

#define IK_IS_POSE(ik) (HK_POSES && (ik)->flags & IK_POSE)
#define IK_IS_AXIS(ik) (HK_POSES && (ik)->flags & IK_AXIS)
#define IK_IN_SPACES(ik) (HK_SPACES && (ik)->n_spaces > 0 && (ik)->flags & IK_LIMITED)
#if HK_OBSTACLES
#define IK_KEEPS_CLEAR(ik) ((ik)->body[IK_N_POINTS] > 0)
#else
#define IK_KEEPS_CLEAR(ik) 0
#endif

enum { IK_WIDTH = HK_POSES && HK_MAX_R < 16 ? 16 : HK_MAX_R }; /* of a target at most */

/* A step: its bounds and the posture step, which go in, and what comes out. */
typedef struct {
    real lower[HK_MAX_N], upper[HK_MAX_N], posture[HK_MAX_N];
    real dq[HK_MAX_N], promised[IK_ROWS], sigma_min, damping; /* promised: to first order */
    unsigned char held[HK_MAX_N];
    int stopped, blocked; /* by half-spaces of the tip; by obstacles */
} ik_step_t;

#if HK_OBSTACLES
/* The entries of the body of a step; without one it has no points. */
static inline const int32_t *ik_body_of(const int32_t *code, int at) {
    static const int32_t none[] = {0, 0};
    const int body = code[at + HK_MORE + IK_BODY];
    return body < 0 ? none : code + body + HK_MORE;
}
#endif

static inline ik_settings ik_settings_of(const int32_t *code, const real *data, int at,
                                         real *work) {
    const int32_t *node = code + at, *more = node + HK_MORE;
    const int n = node[HK_N], m = node[HK_M], flags = more[IK_FLAGS];
    const int n_normals = more[IK_N_NORMALS], n_spaces = more[IK_N_SPACES];
    const real *a = data + node[HK_DATA], *b = a + 6 * n;
    const real *c = b + 5 + 2 * m + (flags & IK_AXIS ? 3 : 0), *d = c + (2 + n_normals) * n;
    const real *scene = d + n_spaces * (m + 1);
#if HK_OBSTACLES
    const int32_t *body = ik_body_of(code, at);
    const int n_points = body[IK_N_POINTS], n_pairs = IK_PAIRS_OF(body, more[IK_N_OBSTACLES]);
#else
    enum { n_points = 0, n_pairs = 0 };
#endif
    const ik_settings ik = {
        .plan = {code, data, R(0.0)},
        .work = work + IK_SLOTS_WORK(n, m, n_normals, n_points, n_pairs),
        .slots = work,
        .model = more[IK_MODEL],
        .n = n,
        .m = m,
        .width = HK_POSES && flags & IK_POSE ? IK_POSE_NUMBERS : m,
        .flags = flags,
        .n_free = HK_POSES && flags & IK_AXIS ? 1 : 0,
        .n_normals = n_normals,
        .n_spaces = n_spaces,
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
        .scale = b + 4,
        .expected = b + 4 + m,
        .most = b[4 + 2 * m],
        .fraction = b[0] < R(0.0) ? IK_FRACTION : R(1.0),
        .axis = b + 5 + 2 * m,
        .period = c,
        .pulls = c + n,
        .normals = c + 2 * n,
        .spaces = d,
        .offsets = d + n_spaces * m,
#if HK_OBSTACLES
        .n_obstacles = more[IK_N_OBSTACLES],
        .body = body,
        .keep = data + code[more[IK_BODY] < 0 ? at + HK_DATA : more[IK_BODY] + HK_DATA],
        .scene = scene,
#endif
        .hysteresis = {more + IK_STAGES, scene + IK_OBSTACLE * more[IK_N_OBSTACLES], n,
                       HK_CREEP_ROUNDING * HK_EPS},
    };
    return ik;
}

/* e (3) = the rotation vector of A B^T, for rotations A and B in poses (4, 4), by the unit
   quaternion, divided by its largest component, which is never small. */
static inline void ik_turn(const real *A, const real *B, real *e) {
    real E[9], w, size;
    int largest = 3;
    for (int i = 0; i < 9; i++) {
        const real *a = A + i / 3 * 4, *b = B + i % 3 * 4;
        E[i] = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    }
    const real trace = E[0] + E[4] + E[8];
    const real skew[3] = {E[7] - E[5], E[2] - E[6], E[3] - E[1]};
    const real squares[4] = {R(1.0) + R(2.0) * E[0] - trace, R(1.0) + R(2.0) * E[4] - trace,
                             R(1.0) + R(2.0) * E[8] - trace, R(1.0) + trace};
    for (int i = 0; i < 3; i++)
        if (squares[i] > squares[largest]) largest = i;
    for (int i = 0; i < 3; i++) {
        e[i] = largest == 3 ? skew[i] : E[3 * i + largest] + E[3 * largest + i];
        if (i == largest) e[i] = squares[i];
    }
    w = largest == 3 ? squares[3] : skew[largest];
    if (w < R(0.0)) w = -w, e[0] = -e[0], e[1] = -e[1], e[2] = -e[2];
    size = ik_norm(3, e);
    const real ratio = size > R(1e-9) * w ? R(2.0) * HK_MATH(atan2)(size, w) / size : R(2.0) / w;
    for (int i = 0; i < 3; i++) e[i] *= ratio;
}

/* c (3) = a x b. */
static inline void ik_cross(const real *a, const real *b, real *c) {
    for (int i = 0; i < 3; i++) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        c[i] = a[j] * b[k] - a[k] * b[j];
    }
}

/* e (3) = the rotation vector of least angle from a to b (3), of any length. Opposite ones turn about
   the cross product of a and the first coordinate axis that is not along it. */
static inline void ik_least_turn(const real *from, const real *to, real *e) {
    const real from_size = ik_norm(3, from), to_size = ik_norm(3, to);
    real a[3], b[3], angle, cosine = R(0.0);
    for (int i = 0; i < 3; i++) {
        a[i] = from[i] / from_size, b[i] = to[i] / to_size;
        cosine += a[i] * b[i];
    }
    ik_cross(a, b, e);
    real sine = ik_norm(3, e);
    angle = HK_MATH(atan2)(sine, cosine);
    if (cosine < R(0.0) && sine * sine <= HK_EPS) {
        const int beside = ik_abs(a[0]) < HK_ASIDE ? 0 : ik_abs(a[1]) < HK_ASIDE ? 1 : 2;
        const real unit[3] = {(real)(beside == 0), (real)(beside == 1), (real)(beside == 2)};
        ik_cross(a, unit, e);
        sine = ik_norm(3, e), angle = IK_HALF_TURN;
    }
    const real ratio = sine > R(0.0) ? angle / sine : R(1.0);
    for (int i = 0; i < 3; i++) e[i] *= ratio;
}

/* The error e (6) of a pose or an axis to a target. */
static HK_NOINLINE void ik_turned(const ik_settings *ik, const real *x, const real *target,
                                  real *e) {
    if (IK_IS_POSE(ik)) {
        for (int i = 0; i < 3; i++) e[i] = target[4 * i + 3] - x[4 * i + 3];
        ik_turn(target, x, e + 3);
    } else {
        for (int i = 0; i < 3; i++) e[i] = target[i] - x[i];
        ik_least_turn(x + 3, target + 3, e + 3);
    }
    for (int i = 0; i < 6; i++) e[i] *= ik->scale[i];
}

/* The error e (m) of x to a target, both of `width` numbers. */
static inline void ik_difference(const ik_settings *ik, const real *x, const real *target,
                                 real *e) {
    if (IK_IS_POSE(ik) || IK_IS_AXIS(ik))
        ik_turned(ik, x, target, e);
    else
        for (int i = 0; i < ik->m; i++) e[i] = ik->scale[i] * (target[i] - x[i]);
}

/* The motion (m) of the task to first order for a step dq (n). */
static HK_NOINLINE void ik_motion(const ik_settings *ik, const real *J, const real *dq,
                                  real *motion) {
    IK_OF(ik->m, ik_rows_of, ik->n, J, dq, motion);
}

/* Shorten a posture step z to half of the step J^T mu of the task, in its null space. */
static HK_NOINLINE void ik_calm_posture(int m, int n, const real *J, const real *mu, real *z) {
    real task[HK_MAX_N] = {R(0.0)};
    for (int i = 0; i < m; i++)
        for (int j = 0; j < n; j++) task[j] += J[n * i + j] * mu[i];
    ik_calm(n, task, z);
}

#include "feedback.h"

/* x (16) of a pose, or (6) with one axis, from the tip and its axes (3, 3). */
static inline void ik_pose_of(const ik_settings *ik, const real *tip, const real *turn, real *x) {
    for (int i = 0; IK_IS_AXIS(ik) && i < 3; i++) {
        x[i] = tip[i], x[3 + i] = R(0.0);
        for (int j = 0; j < 3; j++) x[3 + i] += turn[3 * i + j] * ik->axis[j];
    }
    if (IK_IS_AXIS(ik)) return;
    for (int i = 0; i < 16; i++) {
        const int row = i / 4, column = i % 4;
        x[i] = row == 3 ? (real)(column == 3) : column == 3 ? tip[row] : turn[3 * row + column];
    }
}

/* Make J (m, n) of the model at x that of the task: without turns about an axis, in its units. */
static inline void ik_task_rows(const ik_settings *ik, const real *x, real *J) {
    const int n = ik->n;
    for (int j = 0; IK_IS_AXIS(ik) && j < n; j++) {
        real *turn = J + 3 * n + j, along = R(0.0);
        for (int i = 0; i < 3; i++) along += x[3 + i] * turn[n * i];
        for (int i = 0; i < 3; i++) turn[n * i] -= x[3 + i] * along;
    }
    for (int i = 0; i < ik->m; i++)
        for (int j = 0; ik->scale[i] != R(1.0) && j < ik->n; j++) J[ik->n * i + j] *= ik->scale[i];
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
                                            const real *upper, const ik_rows_t *limits,
                                            real damping_sq, real *dq) {
    const int n = ik->n, m = ik->m;
    real *rows = ik_slot(ik, IK_IN_PLANE), motion[IK_MOST_ROWS], g[IK_MOST_PAIRS];
    /* J is in the unit in which weights are 1, so that only their ratios count. */
    const real stiff = IK_BALANCE * hk_sqrt((real)n) * ik_norm(m * n, J) / ik_norm(n, ik->unit);
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
    ik_within(m + ik->n_normals, n, rows, g, motion, z, lower, upper, limits, damping_sq,
              ik->least > R(0.0), ik_strict_memory(ik), dq);
}

/* Fill in a step for the task v within its bounds; `slides`: with its posture step. `trust` is
   lambda^2 / sigma_max^2 in place of the settings' damping, NULL where that counts; `limits` are rows
   for the unit in which weights are 1. */
HK_INLINE void ik_limited_step_of(int m, int n, const ik_settings *ik, const real *J, const real *v,
                                  int slides, const real *trust, const ik_rows_t *limits,
                                  ik_step_t *s) {
    real ends[2 * HK_MAX_N], z[HK_MAX_N], mu[IK_ROWS], g[IK_PAIRS];
    real low = R(0.0), high, damping_sq, *dq = s->dq;
    const int exact = m != 3 && !trust && (!ik->quick || ik->n_free > 0);
    const real *lower = s->lower, *upper = s->upper;
    for (int j = 0; j < n; j++) z[j] = slides ? s->posture[j] : R(0.0);
    if (ik->flags & IK_WEIGHTS) {
        real *own = ik_slot(ik, IK_WEIGHTED);
        for (int j = 0; j < n; j++) {
            for (int i = 0; i < m; i++) own[n * i + j] = J[n * i + j] * ik->unit[j];
            ends[j] = lower[j] / ik->unit[j];
            ends[n + j] = upper[j] / ik->unit[j];
            z[j] = z[j] / ik->unit[j];
        }
        J = own, lower = ends, upper = ends + n;
    }
    ik_products(m, n, J, NULL, g);
    if (exact) {
        ik_eigen e;
        ik_eigen_of(m, g, &e);
        ik_eigen_ends(m, ik->n_free, &e, &low, &high);
        damping_sq = hk_larger(ik_damping_sq(ik, low, high), ik->least);
        ik_eigen_solve(m, &e, v, damping_sq, mu);
        if (slides) ik_eigen_projection(m, n, J, &e, z);
    } else {
        if (trust)
            damping_sq = *trust * ik_trace(m, g);
        else {
            if (m == 3)
                ik_singular_values(g, &low, &high);
            else
                ik_pivots(m, g, &low, &high);
            damping_sq = hk_larger(ik_damping_sq(ik, low, high), ik->least);
        }
        ik_factors f;
        ik_factor(m, g, damping_sq, &f);
        ik_solve(m, &f, v, mu);
        if (slides) ik_null_projection(m, n, J, g, z);
    }
    if (ik->least > R(0.0)) ik_calm_posture(m, n, J, mu, z);
    ik_columns_of(m, n, J, mu, z, dq);
    if (ik->flags & IK_LIMITED) {
        int over =
            ik->n_normals > 0 && ik->flags & IK_WEIGHTS; /* weights turn J out of the plane */
        for (int j = 0; j < n; j++) over |= ik_clip(dq[j], lower[j], upper[j]) != dq[j];
        over |= HK_LIMITS && ik_breaks(n, limits, dq);
        if (over && ik->n_normals > 0)
            ik_limited_in_plane(ik, J, v, z, slides ? s->posture : NULL, lower, upper, limits,
                                damping_sq, dq);
        else if (over)
            ik_within(m, n, J, g, v, z, lower, upper, limits, damping_sq, ik->least > R(0.0),
                      ik_strict_memory(ik), dq);
    }
    for (int j = 0; j < n; j++) {
        s->held[j] = (unsigned char)((dq[j] <= lower[j]) | (dq[j] >= upper[j]));
        if (ik->flags & IK_WEIGHTS) dq[j] = ik_clip(dq[j] * ik->unit[j], s->lower[j], s->upper[j]);
    }
    s->sigma_min = low;
    s->damping = HK_MATH(sqrt)(damping_sq);
}

static HK_NOINLINE void ik_limited_step(const ik_settings *ik, const real *J, const real *v,
                                        int slides, const real *trust, const ik_rows_t *limits,
                                        ik_step_t *s) {
    switch (HK_COMMON(100 * ik->m + ik->n)) {
    case 306: ik_limited_step_of(3, 6, ik, J, v, slides, trust, limits, s); break;
    case 309: ik_limited_step_of(3, 9, ik, J, v, slides, trust, limits, s); break;
    case 606: ik_limited_step_of(6, 6, ik, J, v, slides, trust, limits, s); break;
    default: IK_OF(ik->m, ik_limited_step_of, ik->n, ik, J, v, slides, trust, limits, s);
    }
}

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

/* The least and the largest step of every actuator. */
typedef struct {
    real lower[HK_MAX_N], upper[HK_MAX_N];
} ik_ends;

/* The bounds of a step as above, or these, unless NULL. */
static inline void ik_bound(const ik_settings *ik, const real *q, real seconds, const real *last,
                            const ik_ends *ends, ik_step_t *s) {
    if (!ends) ik_step_bounds(ik, q, seconds, last, s);
    for (int j = 0; ends && j < ik->n; j++) s->lower[j] = ends->lower[j], s->upper[j] = ends->upper[j];
}

/* The largest change of a motion `way` (m) of the task per period, in multiples of it. */
static inline real ik_braking(const ik_settings *ik, const real *J, const real *way, real seconds,
                              ik_step_t *s) {
    real least = R(INFINITY);
    for (int j = 0; j < ik->n; j++) s->lower[j] = -least, s->upper[j] = least;
    ik_limited_step(ik, J, way, 0, NULL, &ik_no_rows, s);
    for (int j = 0; j < ik->n; j++) {
        const real ratio = ik->accel[j] * seconds * seconds / ik_abs(s->dq[j]);
        least = ratio < least ? ratio : least;
    }
    return least;
}

/* Limit the speed towards target and posture so that the actuators can brake in time: shorten the
   posture step, and return the share of the error e that may be taken back. */
static inline real ik_brake(const ik_settings *ik, const real *q, const real *J, const real *e,
                            real seconds, ik_step_t *s) {
    const real least = ik_braking(ik, J, e, seconds, s);
    for (int j = 0; j < ik->n; j++) {
        const real change = ik->accel[j] * seconds * seconds;
        const real most = ik_stopping(ik_abs(ik->posture[j] - q[j]), change);
        s->posture[j] = ik_clip(s->posture[j], -most, most);
    }
    return ik_stopping(R(1.0), least);
}

/* The components (n_spaces) of a motion of the tip along the normals of the half-spaces. */
static inline void ik_along(const ik_settings *ik, const real *way, real *along) {
    for (int i = 0; i < ik->n_spaces; i++) {
        along[i] = R(0.0);
        for (int r = 0; r < ik->m; r++) along[i] += ik->spaces[r * ik->n_spaces + i] * way[r];
    }
}

/* A motion v (m), moved by the shortest way into what the margins (n_spaces) allow. */
static HK_NOINLINE void ik_allowed(const ik_settings *ik, const real *margin, const real *v,
                                   real *allowed) {
    const int k = ik->n_spaces, m = ik->m;
    real normals[HK_MAX_N * IK_ROWS], ends[HK_MAX_N], low[IK_ROWS], high[IK_ROWS], to[IK_ROWS];
    for (int i = 0; i < k; i++)
        for (int r = 0; r < m; r++) normals[m * i + r] = ik->spaces[r * k + i], ends[i] = margin[i];
    for (int r = 0; r < m; r++) low[r] = -R(INFINITY), high[r] = R(INFINITY);
    const near_problem p = {m, 0, k, NULL, NULL, v, low, high, normals, ends, NULL, R(1.0), R(0.0), NULL, ik_strict_memory(ik)};
    ik_nearest(&p, to);
    for (int r = 0; r < m; r++) allowed[r] = to[r];
}

/* Whether a motion v (m) of the tip would leave the margins, by more than rounding. */
static inline int ik_leaves(const ik_settings *ik, const real *margin, const real *v) {
    real along[HK_MAX_N];
    int any = 0;
    ik_along(ik, v, along);
    for (int i = 0; i < ik->n_spaces; i++) any |= along[i] - margin[i] > R(32.0) * HK_EPS;
    return any;
}

/* The model at one configuration: x (width) and its derivative J (m, n). Every step and tick calls
   this one, and gets the same bits; who includes this file writes it. */
static void ik_model(const ik_settings *ik, const real *q, real *x, real *J);

/* x (width) at q, and the motions J (m, n) of the task that keep to the plane. */
static inline void ik_look(const ik_settings *ik, const real *q, real *x, real *J) {
    ik_model(ik, q, x, J);
    ik_task_rows(ik, x, J);
    ik_in_plane(ik, ik->m, J);
}

/* A step of a model whose Jacobian jumps where tendons get slack or taut: J where it ends, and what
   is missing there of the motion of the tip, as the model computes it. */
typedef struct {
    real dq[HK_MAX_N], missing[IK_ROWS], distance, *J;
} ik_end;

static inline void ik_copy_end(const ik_settings *ik, const ik_end *from, ik_end *to) {
    for (int j = 0; j < ik->n; j++) to->dq[j] = from->dq[j];
    for (int i = 0; i < ik->m; i++) to->missing[i] = from->missing[i];
    for (int i = 0; i < ik->m * ik->n; i++) to->J[i] = from->J[i];
    to->distance = from->distance;
}

/* The length of a column of J (m, n). */
static inline real ik_column(const ik_settings *ik, const real *J, int j) {
    real sum = R(0.0);
    for (int i = 0; i < ik->m; i++) sum += J[ik->n * i + j] * J[ik->n * i + j];
    return HK_MATH(sqrt)(sum);
}

/* Clear what a learned error makes of the columns of slack tendons: it would drive them far. */
static void ik_clear_slack(const ik_settings *ik, real *J) {
    real size[HK_MAX_N], largest = R(0.0);
    for (int j = 0; j < ik->n; j++) {
        size[j] = ik_column(ik, J, j);
        largest = hk_larger(size[j], largest);
    }
    for (int j = 0; j < ik->n; j++)
        if (ik->pulls[j] != R(0.0) && size[j] <= IK_SLACK * largest)
            for (int i = 0; i < ik->m; i++) J[ik->n * i + j] = R(0.0);
}

static void ik_evaluate(const ik_settings *ik, const real *q, const real *x, const real *motion,
                        ik_end *end) {
    real at[HK_MAX_N], tip[IK_WIDTH], moved[IK_ROWS];
    for (int j = 0; j < ik->n; j++) at[j] = q[j] + end->dq[j];
    ik_look(ik, at, tip, end->J);
    ik_clear_slack(ik, end->J);
    ik_difference(ik, x, tip, moved);
    for (int i = 0; i < ik->m; i++) end->missing[i] = motion[i] - moved[i];
    end->distance = ik_norm(ik->m, end->missing);
}

/* Newton's method for a motion of the tip, from an end and within the bounds of the step: the
   nearest of a few ends. */
static void ik_approach(const ik_settings *ik, const real *q, const real *x, const real *motion,
                        real close, const ik_step_t *s, ik_end *best) {
    ik_end end = {.J = ik_slot(ik, IK_END + 2)};
    ik_evaluate(ik, q, x, motion, best);
    ik_copy_end(ik, best, &end);
    for (int i = 0; i < IK_CORRECTIONS && best->distance > close; i++) {
        ik_step_t more;
        for (int j = 0; j < ik->n; j++) {
            more.lower[j] = s->lower[j] - end.dq[j];
            more.upper[j] = s->upper[j] - end.dq[j];
        }
        ik_limited_step(ik, end.J, end.missing, 0, NULL, &ik_no_rows, &more);
        for (int j = 0; j < ik->n; j++) {
            end.dq[j] = ik_clip(end.dq[j] + more.dq[j], s->lower[j], s->upper[j]);
            if (more.dq[j] <= more.lower[j]) end.dq[j] = s->lower[j]; /* to the last bit */
            if (more.dq[j] >= more.upper[j]) end.dq[j] = s->upper[j];
        }
        ik_evaluate(ik, q, x, motion, &end);
        if (end.distance < best->distance) ik_copy_end(ik, &end, best);
    }
}

/* Pull in slack tendons by a share of the way to the bounds, and let none of them out: else they
   could be let out where they began. Return whether any moved. */
static int ik_pull_in(const ik_settings *ik, real share, ik_step_t *s, ik_end *end) {
    int moved = 0;
    for (int j = 0; j < ik->n; j++) {
        const int down = ik->pulls[j] < R(0.0);
        const real to = down ? s->lower[j] : s->upper[j], way = to - end->dq[j];
        const int slack = ik->pulls[j] != R(0.0) && !(ik_column(ik, end->J, j) > R(0.0));
        if (!slack || !ik_finite(1, &way)) continue;
        *(down ? s->upper + j : s->lower + j) = end->dq[j];
        end->dq[j] = ik_clip(to - (R(1.0) - share) * way, s->lower[j], s->upper[j]);
        moved |= way != R(0.0);
    }
    return moved;
}

/* Change a step so that the tip of the model moves as the step promised. Where that is less than
   half of the motion v, pull in slack tendons, as far as the tip gets nearer to v or not away. */
static void ik_arrive(const ik_settings *ik, const real *q, const real *x, const real *J,
                      const real *v, ik_step_t *s) {
    const int n = ik->n, m = ik->m;
    const real slip =
        ik_norm(m * n, J) * (IK_SLIP * ik_norm(n, s->dq) + R(32.0) * HK_EPS * ik_norm(n, q));
    const real *promised = s->promised;
    real left[IK_ROWS];
    ik_end end = {.J = ik_slot(ik, IK_END)}, pulled = {.J = ik_slot(ik, IK_END + 1)};
    for (int j = 0; j < n; j++) end.dq[j] = s->dq[j];
    ik_approach(ik, q, x, promised, hk_larger(R(0.5) * ik_norm(m, promised), slip), s, &end);
    for (int i = 0; i < m; i++) left[i] = v[i] - promised[i] + end.missing[i];
    const real rounding = R(1.0) + HK_MATH(sqrt)(HK_EPS); /* a slack tendon does not move the tip */
    const real most = ik_norm(m, left), close = hk_larger(R(0.5) * ik_norm(m, v), slip);
    ik_step_t inwards = *s;
    for (real share = R(1.0); most > close && share > IK_LEAST_PULL; share *= IK_PULL_RATIO) {
        ik_copy_end(ik, &end, &pulled);
        if (!ik_pull_in(ik, share, &inwards, &pulled)) break;
        ik_approach(ik, q, x, v, slip, &inwards, &pulled);
        if (pulled.distance > rounding * most) continue;
        ik_copy_end(ik, &pulled, &end);
        break;
    }
    for (int j = 0; j < n; j++) {
        s->dq[j] = end.dq[j];
        s->held[j] = (unsigned char)((s->dq[j] <= s->lower[j]) | (s->dq[j] >= s->upper[j]));
    }
}

#include "rest.h"

/* What a step is for: the task v at q, of which half-spaces of the tip allow a part, from an error e.
   J is that of taut tendons alone. */
typedef struct {
    const real *q, *x, *J, *e, *v, *allowed;
} ik_wish_t;

/* Whether a step goes beyond a row of other limits than its bounds, by more than rounding. */
static inline int ik_leaves_rows(const ik_settings *ik, const ik_rows_t *limits, const real *dq) {
    real own[HK_MAX_N];
    for (int j = 0; j < ik->n; j++) own[j] = ik->flags & IK_WEIGHTS ? dq[j] / ik->unit[j] : dq[j];
    return ik_breaks(ik->n, limits, own);
}

/* Propose a step within its bounds and rows: with the way out of a singular configuration, and where
   tendons can only pull it arrives. */
static HK_NOINLINE void ik_propose(const ik_settings *ik, const ik_wish_t *wish,
                                   const ik_rows_t *limits, ik_step_t *s) {
    const real *J = wish->J;
    ik_limited_step(ik, J, wish->v, ik->flags & IK_POSTURE, NULL, limits, s);
    ik_motion(ik, J, s->dq, s->promised);
    if (ik->flags & IK_PULLS) {
        const ik_step_t before = *s;
        if (ik_finite(ik->n, s->dq)) ik_arrive(ik, wish->q, wish->x, J, wish->allowed, s);
        if (HK_LIMITS && ik_leaves_rows(ik, limits, s->dq)) *s = before; /* arrival knows no rows */
    } else if (!IK_IN_SPACES(ik)) {
        const real damping_sq = s->damping * s->damping;
        const int lost = !(s->sigma_min > R(0.0)) || damping_sq > R(1.001) * ik->least;
        if (!lost || !(ik_norm(ik->m, wish->e) > R(0.0))) return;
        if (ik_norm(ik->m, s->promised) > IK_STUCK * ik_norm(ik->m, wish->v)) return;
        ik_escape(ik, wish->q, J, wish->e, s);
        ik_motion(ik, J, s->dq, s->promised);
    }
}

#if HK_OBSTACLES
#include "obstacles.h"
#endif

/* Write the rows A (n_spaces, n) of the half-spaces and what is left up to them, b, with `tip` (m)
   where they see it; with a limit of acceleration so little that the robot can stop. */
static inline void ik_space_rows(const ik_settings *ik, const real *J, const real *tip,
                                 real seconds, ik_step_t *s, real *A, real *b) {
    const int k = ik->n_spaces;
    real left[HK_MAX_N];
    ik_along(ik, tip, left);
    for (int i = 0; i < k; i++) {
        b[i] = ik->offsets[i] - left[i];
        for (int j = 0; j < ik->n; j++, A++) {
            *A = R(0.0);
            for (int r = 0; r < ik->m; r++) *A += ik->spaces[r * k + i] * J[ik->n * r + j];
            if (ik->flags & IK_WEIGHTS) *A *= ik->unit[j];
        }
    }
    for (int i = 0; i < k && ik->flags & IK_ACCELERATES; i++) {
        real normal[IK_ROWS];
        for (int r = 0; r < ik->m; r++) normal[r] = ik->spaces[r * k + i];
        b[i] = ik_stopping(b[i], ik_braking(ik, J, normal, seconds, s));
    }
}

/* Eq. (1) for one period from q: the error e and the motion `feed` of the target (may be NULL) are
   taken back. `tip` (m) is where half-spaces see it. What is not finite, or overflows, holds still,
   with a limit of acceleration after it has braked; from outside the limits the actuators that are
   known walk back. The step is within `ends`, if not NULL, in place of its limits. */
static HK_NOINLINE void ik_control(const ik_settings *ik, const real *q, const real *x,
                                   const real *J, const real *e, const real *feed, real seconds,
                                   const real *last, const real *tip, const ik_ends *ends,
                                   ik_step_t *s) {
    const int n = ik->n, m = ik->m;
    real v[IK_ROWS], allowed[IK_ROWS], b[IK_MOST_LIMITS];
    real gain = ik->gain < R(0.0) ? R(1.0) : ik->gain * seconds, beta = ik->beta * seconds;
    gain = gain > R(1.0) ? R(1.0) : gain;
    beta = beta > R(1.0) ? R(1.0) : beta;
    for (int i = 0; i < m; i++) v[i] = gain * e[i] + (feed ? feed[i] : R(0.0));
    const real sizes[2] = {ik_norm(m, e), ik_norm(m, v)};
    const int known = !last || ik_finite(n, last);
    s->stopped = s->blocked = 0;
    if (known && ik_finite(n, q) && ik_finite(m * n, J) && ik_finite(2, sizes)) {
        const real *whole = J;
        if (ik->flags & IK_PULLS) {
            real *taut = ik_slot(ik, IK_TAUT);
            for (int j = 0; j < m * n; j++) taut[j] = J[j];
            ik_clear_slack(ik, taut);
            J = taut;
        }
        for (int j = 0; j < n; j++) s->posture[j] = beta * (ik->posture[j] - q[j]);
        if (ik->flags & IK_ACCELERATES) {
            const real share = ik_brake(ik, q, J, e, seconds, s);
            for (int i = 0; i < m; i++)
                v[i] = (share < gain ? share : gain) * e[i] + (feed ? feed[i] : R(0.0));
        }
        ik_wish_t wish = {q, x, J, e, v, v};
        ik_rows_t limits = ik_no_rows;
        if (HK_LIMITS) limits.A = ik_rows_memory(ik), limits.b = b;
        if (IK_IN_SPACES(ik)) {
            limits.k = ik->n_spaces;
            ik_space_rows(ik, J, tip, seconds, s, ik_rows_memory(ik), b);
            s->stopped = ik_leaves(ik, b, v);
            if (s->stopped) ik_allowed(ik, b, v, allowed), wish.allowed = allowed;
        }
        ik_bound(ik, q, seconds, last, ends, s);
        (void)whole;
#if HK_OBSTACLES
        if (IK_KEEPS_CLEAR(ik))
            ik_step_clear(ik, &wish, whole, seconds, &limits, ik_rows_memory(ik), b, s);
        else
#endif
            ik_propose(ik, &wish, &limits, s);
        if (ik_finite(n, s->dq)) return; /* else v is too large to compute with */
    }
    ik_bound(ik, q, seconds, known ? last : NULL, ends, s);
    for (int j = 0; j < n; j++) {
        s->dq[j] = ik_finite(1, q + j) ? ik_clip(R(0.0), s->lower[j], s->upper[j]) : R(0.0);
        s->held[j] = (unsigned char)((s->dq[j] <= s->lower[j]) | (s->dq[j] >= s->upper[j]));
    }
    for (int i = 0; i < m; i++) s->promised[i] = R(0.0);
    s->sigma_min = R(NAN), s->damping = R(0.0);
}

/* The parts of the state of a robot that follows targets. */
typedef struct {
    real *target, *feed, *tip, *offset, *x, *error, *q, *dq, *before, *held, *rest, *J;
    real *lead, *tried; /* with hysteresis: its state, and one to try */
    real *scene;        /* the obstacles; not of a step alone */
    real *seen;         /* the state of readings; not of a step alone */
} ik_state;

#define IK_STATE_SIZE(n, m, width)                                                                 \
    (IK_TARGET + 3 * (width) + 3 * (m) + 4 * (n) + IK_REST_SIZE(m) + (m) * (n))

static inline ik_state ik_state_of(const ik_settings *ik, real *state) {
    ik_state parts;
    parts.target = state + IK_TARGET;
    parts.feed = parts.target + ik->width;
    parts.tip = parts.feed + ik->m;
    parts.offset = parts.tip + ik->width;
    parts.x = parts.offset + ik->m;
    parts.error = parts.x + ik->width;
    parts.q = parts.error + ik->m;
    parts.dq = parts.q + ik->n;
    parts.before = parts.dq + ik->n;
    parts.held = parts.before + ik->n;
    parts.rest = parts.held + ik->n;
    parts.J = parts.rest + IK_REST_SIZE(ik->m);
    parts.lead = parts.J + ik->m * ik->n;
    parts.tried = parts.scene = parts.lead;
    if (HK_HYSTERESIS && ik->hysteresis.code[0] > 0) {
        parts.tried += ik->hysteresis.code[HK_STATE_ROWS] * ik->n;
        parts.scene = parts.tried + ik->hysteresis.code[HK_STATE_ROWS] * ik->n;
    }
    parts.seen = parts.scene;
#if HK_OBSTACLES
    parts.seen += IK_OBSTACLE * ik->n_obstacles;
#endif
    return parts;
}

/* Whether a pose (4, 4) holds a rotation, or something that is not finite. */
static inline int ik_is_rotation(const real *T) {
    real off = R(0.0);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++)
            if (!ik_finite(1, T + 4 * i + j)) return 1;
        for (int j = 0; j <= i; j++) {
            real product = i == j ? R(-1.0) : R(0.0);
            for (int l = 0; l < 3; l++) product += T[4 * l + i] * T[4 * l + j];
            off = hk_larger(ik_abs(product), off);
        }
    }
    const real det = T[0] * (T[5] * T[10] - T[6] * T[9]) - T[1] * (T[4] * T[10] - T[6] * T[8]) +
                     T[2] * (T[4] * T[9] - T[5] * T[8]);
    return off <= R(1e-3) && det > R(0.0);
}

/* Whether x holds a rotation or a direction, as the task needs it, or what is not finite. */
static inline int ik_is_valid(const ik_settings *ik, const real *x) {
    if (IK_IS_AXIS(ik)) return !(ik_norm(3, x + 3) <= IK_NO_AXIS);
    return !IK_IS_POSE(ik) || ik_is_rotation(x);
}

/* Take what a measured tip does not tell, its rotation or axis, from x; it has a position. */
static inline void ik_complete(const ik_settings *ik, const real *x, real *tip) {
    const int poses = IK_IS_POSE(ik);
    int unknown = poses || IK_IS_AXIS(ik);
    for (int i = 0; i < 3 && unknown; i++) {
        unknown &= ik_finite(1, tip + (poses ? 4 * i + 3 : i));
        for (int j = 0; j < (poses ? 3 : 1); j++) {
            const real turn = tip[poses ? 4 * i + j : 3 + i];
            unknown &= turn != turn;
        }
    }
    for (int i = 0; i < ik->width && unknown; i++)
        if (poses ? i % 4 < 3 : i > 2) tip[i] = x[i];
}

/* y (n) = what actuators would do after a command q, by the state that is tried. */
static inline void ik_try(const ik_settings *ik, const ik_state *now, real seconds, const real *q,
                          real *y) {
    const int n = ik->n, last = (ik->hysteresis.code[HK_STATE_ROWS] - 1) * n;
    for (int i = n; i < last + n; i++) now->tried[i] = now->lead[i];
    for (int j = 0; j < n; j++) /* what is infinite has no limit */
        now->tried[j] = ik_finite(1, q + j) ? q[j] : now->lead[j];
    hk_hysteresis_apply(&ik->hysteresis, seconds, now->tried);
    for (int j = 0; j < n; j++) y[j] = ik_finite(1, q + j) ? now->tried[last + j] : q[j];
}

/* The ends of what actuators do after commands from `low` to `high` (n), as y is monotone in q. */
static inline void ik_try_ends(const ik_settings *ik, const ik_state *now, real seconds,
                               const real *low, const real *high, ik_ends *ends) {
    const real *y = now->lead + (ik->hysteresis.code[HK_STATE_ROWS] - 1) * ik->n;
    ik_try(ik, now, seconds, low, ends->lower);
    ik_try(ik, now, seconds, high, ends->upper);
    for (int j = 0; j < ik->n; j++) {
        ends->lower[j] -= y[j];
        ends->upper[j] = hk_larger(ends->upper[j] - y[j], ends->lower[j]);
    }
}

/* `goal` (n), what the actuators are to do, becomes the commands for it. */
static inline void ik_commands_for(const ik_settings *ik, const ik_state *now, real seconds,
                                   real *goal) {
    for (int i = 0; i < ik->hysteresis.code[HK_STATE_ROWS] * ik->n; i++)
        now->tried[i] = now->lead[i];
    hk_hysteresis_command(&ik->hysteresis, seconds, goal, now->tried);
}

/* Commands (n) for a step dq of the actuators. One that would move far for almost nothing, such as
   through a backlash for rounding, is that of an actuator that stays, or stays itself; `kept` (n) is
   what they do without a new command. */
static inline void ik_command(const ik_settings *ik, const ik_state *now, real seconds,
                              const real *kept, const real *dq, real *command) {
    const int n = ik->n;
    const real *y = now->lead + (ik->hysteresis.code[HK_STATE_ROWS] - 1) * n;
    real still[HK_MAX_N];
    int tiny = 0;
    for (int j = 0; j < n; j++) command[j] = y[j] + dq[j], still[j] = y[j];
    ik_commands_for(ik, now, seconds, command);
    for (int j = 0; j < n; j++)
        tiny |= ik_abs(dq[j]) < IK_AT_REST_SHARE * ik_abs(command[j] - now->q[j]);
    if (tiny) ik_commands_for(ik, now, seconds, still);
    for (int j = 0; j < n; j++) {
        real moved = y[j] + dq[j] - kept[j];
        if (tiny && ik_abs(dq[j]) < IK_AT_REST_SHARE * ik_abs(command[j] - still[j]))
            command[j] = still[j], moved = y[j] - kept[j];
        if (ik_abs(moved) < IK_AT_REST_SHARE * ik_abs(command[j] - now->q[j]))
            command[j] = now->q[j];
    }
}

#if HK_OBSTACLES
/* Whether commands (n), or those while they stop, lead into an obstacle. */
static int ik_commands_lead_in(const ik_settings *ik, const ik_state *now, real seconds,
                               const real *goal, ik_near_t *near) {
    const int n = ik->n, stops = ik->flags & IK_ACCELERATES;
    const real *y = now->lead + (ik->hysteresis.code[HK_STATE_ROWS] - 1) * n;
    real command[HK_MAX_N], way[HK_MAX_N], most = R(0.0), periods = R(INFINITY);
    for (int j = 0; stops && j < n; j++) {
        const real step = ik_abs(goal[j] - now->q[j]) / (ik->accel[j] * seconds * seconds);
        most = hk_larger(HK_MATH(floor)(step), most);
    }
    for (int k = 0; k <= IK_BRAKED + 1; k++) {
        for (int j = 0; j < n; j++) {
            const real change = ik->accel[j] * seconds * seconds, step = goal[j] - now->q[j];
            command[j] = goal[j] + (stops ? ik_way_to_stop(step, change, periods) : R(0.0));
        }
        ik_try(ik, now, seconds, command, way);
        for (int j = 0; j < n; j++) way[j] -= y[j];
        if (ik_take_gaps(ik, y, way, near)) return 1;
        periods = k == 0 ? R(0.0) : ik_next_place(periods);
        if (!(periods < most)) return 0;
    }
    return 0;
}

/* Shorten commands `goal` (n) within their bounds towards the hardest braking, until the body is clear
   after them, and can stop: a command that crosses a backlash has a speed that its actuator does not
   have yet. Returns whether they changed. */
static HK_NOINLINE int ik_clear_commands(const ik_settings *ik, const ik_state *now, real seconds,
                                         const real *low, const real *high, real *goal) {
    const int n = ik->n;
    real wanted[HK_MAX_N], brake[HK_MAX_N], part = R(1.0);
    ik_near_t near = ik_near_again(ik);
    for (int j = 0; j < n; j++) {
        goal[j] = wanted[j] = ik_clip(goal[j], low[j], high[j]);
        brake[j] = ik_clip(now->q[j], low[j], high[j]);
    }
    for (int halving = 0; halving <= IK_SHORTER; halving++) {
        if (!ik_commands_lead_in(ik, now, seconds, goal, &near)) return halving > 0;
        part = halving < IK_SHORTER ? R(0.5) * part : R(0.0);
        for (int j = 0; j < n; j++) goal[j] = brake[j] + part * (wanted[j] - brake[j]);
    }
    return 1;
}
#endif

/* One period with hysteresis: limits are those of commands, the law is that of what actuators do.

   First the step without limits of speed and acceleration. If its commands are beyond these, the step
   within what the actuators can do in this period. Where hysteresis stops one of them on its way, its
   command goes on, and can stop where the first step has it. */
static HK_NOINLINE void ik_lead(const ik_settings *ik, const ik_state *now, const real *e,
                                const real *feed, real seconds, const real *last, const real *tip,
                                ik_step_t *s) {
    const int n = ik->n;
    const real *y = now->lead + (ik->hysteresis.code[HK_STATE_ROWS] - 1) * n;
    real low[HK_MAX_N], high[HK_MAX_N], kept[HK_MAX_N], wanted[HK_MAX_N], goal[HK_MAX_N];
    real missed[HK_MAX_N], moved[IK_ROWS];
    ik_step_t limits;
    ik_ends ends;
    int beyond = 0;
    ik_step_bounds(ik, now->q, seconds, last && ik_finite(n, last) ? last : NULL, &limits);
    for (int j = 0; j < n; j++) {
        low[j] = ik->flags & IK_LIMITED ? ik->low[j] : -R(INFINITY);
        high[j] = ik->flags & IK_LIMITED ? ik->high[j] : R(INFINITY);
    }
    ik_try(ik, now, seconds, now->q, kept);
    ik_try_ends(ik, now, seconds, low, high, &ends);
    ik_control(ik, y, now->x, now->J, e, feed, seconds, last, tip, &ends, s);
    ik_command(ik, now, seconds, kept, s->dq, wanted);
    for (int j = 0; j < n; j++) {
        const real way = wanted[j] - now->q[j], change = ik->accel[j] * seconds * seconds;
        /* So fast that it can arrive at the speed of the actuator there. */
        const real most = ik_stopping(ik_abs(way) + s->dq[j] * s->dq[j] / (R(2.0) * change), change);
        low[j] = now->q[j] + limits.lower[j], high[j] = now->q[j] + limits.upper[j];
        goal[j] = wanted[j];
        if (change < R(INFINITY) && way > R(0.0))
            high[j] = ik_clip(now->q[j] + most, low[j], high[j]);
        else if (change < R(INFINITY) && way < R(0.0))
            low[j] = ik_clip(now->q[j] - most, low[j], high[j]);
        beyond |= !(wanted[j] >= low[j] && wanted[j] <= high[j]);
    }
    if (beyond) {
        ik_try_ends(ik, now, seconds, low, high, &ends);
        ik_control(ik, y, now->x, now->J, e, feed, seconds, last, tip, &ends, s);
        ik_command(ik, now, seconds, kept, s->dq, goal);
        for (int j = 0; j < n; j++) {
            const real close = IK_AT_REST_SHARE * ik_abs(wanted[j] - now->q[j]);
            const int down = s->dq[j] <= ends.lower[j] + close && wanted[j] < goal[j];
            const int up = s->dq[j] >= ends.upper[j] - close && wanted[j] > goal[j];
            if (down || up) goal[j] = wanted[j];
        }
    }
    const int unknown = s->sigma_min != s->sigma_min;
    for (int j = 0; unknown && j < n; j++) goal[j] = now->q[j]; /* hold still */
#if HK_OBSTACLES
    if (IK_KEEPS_CLEAR(ik) && !unknown)
        s->blocked |= ik_clear_commands(ik, now, seconds, low, high, goal);
#endif
    for (int j = 0; j < n; j++) {
        now->lead[j] = ik_clip(goal[j], low[j], high[j]);
        missed[j] = y[j] + s->dq[j];
        s->dq[j] = now->lead[j] - now->q[j];
        s->held[j] = (unsigned char)((now->lead[j] <= low[j]) | (now->lead[j] >= high[j]));
    }
    hk_hysteresis_apply(&ik->hysteresis, seconds, now->lead);
    for (int j = 0; j < n; j++) missed[j] = y[j] - missed[j];
    ik_motion(ik, now->J, missed, moved);
    for (int i = 0; i < ik->m; i++) s->promised[i] += moved[i];
}

/* One period of a robot that follows targets, with what readings have `seen` (unused by a step alone,
   which must see). Returns 0, and does nothing, if a target or a measured tip in the state holds no
   rotation or direction. */
static inline int ik_tick(const ik_settings *ik, real *state, real *seen) {
    const int n = ik->n, m = ik->m, mode = (int)state[IK_MODE];
    const ik_state now = ik_state_of(ik, state);
    const real period = state[IK_PERIOD], *tip = mode & IK_HAS_TIP ? now.tip : NULL;
    const int alone = mode & IK_MUST_SEE;
    const int leads = HK_HYSTERESIS && mode & IK_LEADS;
    real *at = leads ? now.tried - n : now.q; /* where the model is */
    real used[IK_ROWS], shown[IK_ROWS], seen_at[IK_ROWS], *last = NULL, moved[HK_MAX_N];
    real x_before[IK_WIDTH], before[IK_ROWS];
    ik_settings damped;
    ik_step_t step;
    if ((mode & IK_HAS_TARGET && !ik_is_valid(ik, now.target)) || (tip && !ik_is_valid(ik, tip)))
        return 0;
    for (int i = 0; i < ik->width; i++) x_before[i] = now.x[i];
    ik_look(ik, at, now.x, now.J);
    if (!alone) {
        ik_record(ik, seen, now.x);
        ik_hear(ik, seen, tip, state[IK_MEMORY], now.offset, shown);
    }
    for (int i = 0; i < m; i++) used[i] = before[i] = R(0.0), now.error[i] = R(NAN);
    if (mode & IK_HAS_TARGET) {
        ik_difference(ik, now.x, now.target, used);
        ik_difference(ik, x_before, now.target, before);
        for (int i = 0; i < m; i++) before[i] -= used[i];
        if (alone && tip) ik_complete(ik, now.x, now.tip);
        if (alone) ik_difference(ik, tip ? tip : now.x, now.target, now.error);
        for (int i = 0; i < m; i++) {
            if (alone) now.offset[i] = used[i] - now.error[i];
            else now.error[i] = used[i] - shown[i];
            used[i] = alone ? now.error[i] : used[i] - now.offset[i];
        }
    }
    for (int i = 0; i < m; i++) seen_at[i] = now.x[i] + now.offset[i];
    if (ik->flags & IK_ACCELERATES && !(mode & IK_FROM_REST)) {
        const real ratio = state[IK_LAST] > R(0.0) ? period / state[IK_LAST] : R(1.0);
        last = moved;
        for (int j = 0; j < n; j++) last[j] = ratio * now.dq[j];
    }
    const real *feed = mode & IK_HAS_FEED ? now.feed : NULL;
    for (int i = 0; i < m; i++) before[i] += used[i];
    const real least = alone ? R(0.0) : ik_rest(ik, now.J, before, used, now.rest);
    if (least > R(0.0)) damped = *ik, damped.least = least, ik = &damped;
    for (int j = 0; j < n; j++) now.before[j] = at[j];
    if (leads)
        ik_lead(ik, &now, used, feed, period, last, seen_at, &step);
    else
        ik_control(ik, now.q, now.x, now.J, used, feed, period, last, seen_at, NULL, &step);
    state[IK_LAST] = period;
    if (!alone) seen[IK_SINCE] = period;
    state[IK_SIGMA_MIN] = step.sigma_min;
    state[IK_DAMPING] = step.damping;
    state[IK_DISTANCE] = ik_norm(m, now.error);
    state[IK_STOPPED] = (real)step.stopped;
    if (HK_OBSTACLES) state[IK_BLOCKED] = (real)step.blocked;
    for (int j = 0; j < n; j++) {
        now.dq[j] = step.dq[j];
        now.held[j] = step.held[j];
        now.q[j] = leads ? now.lead[j] : now.q[j] + step.dq[j];
    }
    ik_remember(ik, now.before, at, step.promised, used, now.rest);
    return 1;
}
