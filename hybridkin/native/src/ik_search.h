/* The search for configurations that reach targets of any task, one row per target, HK_LANES rows at
   a time.

   Every row is a state machine: it requests the model at a configuration and processes the result.
 */

/* Modes: lower the error; if the target is reached, slide into the domain, or to the posture. */
enum { IK_FIRST, IK_LOWER, IK_SLIDE, IK_POLISH, IK_DONE };

typedef struct {
    real q[HK_MAX_N], J[IK_ROWS * HK_MAX_N], e[IK_ROWS], error, distance;
} ik_point;

typedef struct {
    int64_t row;
    int phase, iteration, n_iter, found, inside;
    real start, nu, growth, predicted, share; /* of the descent, and of the slide */
    real target[IK_WIDTH], ask[HK_MAX_N], wish[HK_MAX_N], free[HK_MAX_N];
    int slow;
    ik_point live, best;
    ik_step_t step;
} ik_row;

typedef struct {
    ik_settings ik;
    int mode, max_iter;
    int parts;       /* of the error, of three rows each, with tolerances of their own; 0: none */
    const real *tol; /* of the whole error, or of every part */
} ik_search_t;

static inline void ik_keep(const ik_settings *ik, ik_point *to, const ik_point *from) {
    for (int j = 0; j < ik->n; j++) to->q[j] = from->q[j];
    for (int j = 0; j < ik->m * ik->n; j++) to->J[j] = from->J[j];
    for (int i = 0; i < ik->m; i++) to->e[i] = from->e[i];
    to->error = from->error, to->distance = from->distance;
}

/* Request the point after a step. A turning joint may pass its limit and continue at the other one.
 */
static inline void ik_ask(const ik_settings *ik, ik_row *r, int phase) {
    r->phase = phase;
    for (int j = 0; j < ik->n; j++) {
        real q = r->live.q[j] + r->step.dq[j];
        if (ik->period[j] < R(INFINITY) && phase == IK_LOWER) {
            if (q > ik->high[j]) q -= ik->period[j];
            if (q < ik->low[j]) q += ik->period[j];
            q = ik_clip(q, ik->low[j], ik->high[j]);
        }
        r->ask[j] = q;
    }
}

static inline int ik_reached(const ik_search_t *s, const ik_point *at) {
    int all = 1;
    if (s->parts == 0) return at->error <= s->tol[0];
    for (int k = 0; k < s->parts; k++) all &= ik_norm(3, at->e + 3 * k) <= s->tol[k];
    return all;
}

/* Whether no motion within the limits lowers the error to first order. */
static inline int ik_blocked(const ik_settings *ik, const ik_point *at) {
    const int n = ik->n, limited = ik->flags & IK_LIMITED;
    real left = R(0.0), pull[HK_MAX_N];
    for (int j = 0; j < n; j++) pull[j] = R(0.0);
    IK_OF(ik->m, ik_columns_of, n, at->J, at->e, pull, pull);
    for (int j = 0; j < n; j++) {
        const int held = limited && !(ik->period[j] < R(INFINITY));
        const int out = held && ((at->q[j] >= ik->high[j] && pull[j] > R(0.0)) ||
                                 (at->q[j] <= ik->low[j] && pull[j] < R(0.0)));
        left += out ? R(0.0) : pull[j] * pull[j];
    }
    return HK_MATH(sqrt)(left) <= IK_STATIONARY * ik_norm(ik->m * n, at->J) * at->error;
}

/* The wanted step of a slide from a point, and its part that does not move the tip. */
static void ik_wish(const ik_search_t *s, const ik_point *at, real *wish, real *free) {
    const ik_settings *ik = &s->ik;
    const int n = ik->n;
    real *J = ik_slot(ik, IK_WISHED), g[IK_PAIRS];
    if (s->mode & IK_TO_DOMAIN) { /* Newton's step of the domain distance */
        real distance, square = R(0.0);
        hk_domain(&ik->plan, ik->model, at->q, &distance, wish, ik->work);
        for (int j = 0; j < n; j++) square += wish[j] * wish[j];
        const real beyond = distance - IK_INSIDE;
        const real share =
            (beyond < R(0.0) ? R(0.0) : beyond) / (square > R(0.0) ? square : R(1.0));
        for (int j = 0; j < n; j++) wish[j] = -share * wish[j];
    } else
        for (int j = 0; j < n; j++) wish[j] = ik->posture[j] - at->q[j];
    for (int j = 0; j < n; j++) {
        for (int i = 0; i < ik->m; i++) J[n * i + j] = at->J[n * i + j] * ik->unit[j];
        free[j] = wish[j] / ik->unit[j];
    }
    IK_OF(ik->m, ik_products, n, J, NULL, g);
    IK_OF(ik->m, ik_null_projection, n, J, g, free);
    for (int j = 0; j < n; j++) free[j] *= ik->unit[j];
}

/* Ask for the next point of a slide: a share of the free step; at the end what lies at a limit is
   held, and only the error counts. */
static void ik_slide_on(const ik_search_t *s, ik_row *r, int phase) {
    const int n = s->ik.n, slides = phase == IK_SLIDE && r->iteration < IK_NULL_STEPS - 1;
    if (phase == IK_POLISH) ik_keep(&s->ik, &r->live, &r->best);
    ik_step_bounds(&s->ik, r->live.q, R(0.0), NULL, &r->step);
    for (int j = 0; j < n; j++) {
        real *lower = r->step.lower + j, *upper = r->step.upper + j;
        r->step.posture[j] = r->share * r->free[j];
        if (phase == IK_POLISH && (*lower >= R(0.0) || *upper <= R(0.0))) *lower = *upper = R(0.0);
    }
    ik_limited_step(&s->ik, r->live.J, r->live.e, slides, NULL, &ik_no_rows, &r->step);
    ik_ask(&s->ik, r, phase);
}

/* From here a row slides, or is done. */
static void ik_settle(const ik_search_t *s, ik_row *r) {
    const int outside = r->live.distance > R(1.0);
    ik_keep(&s->ik, &r->best, &r->live);
    r->phase = IK_DONE;
    if (!(r->found & IK_REACHED)) return;
    if (!(s->mode & IK_TO_POSTURE) && !((s->mode & IK_TO_DOMAIN) && outside)) return;
    r->inside = !outside, r->iteration = 0, r->share = R(1.0);
    ik_wish(s, &r->live, r->wish, r->free);
    ik_slide_on(s, r, IK_SLIDE);
}

/* Levenberg and Marquardt: ask for the next point, or settle. */
static void ik_lower_on(const ik_search_t *s, ik_row *r) {
    const int n = s->ik.n, m = s->ik.m, reached = ik_reached(s, &r->live);
    const int rests =
        ik_blocked(&s->ik, &r->live) || r->nu > IK_LAST_DAMPING || r->slow >= IK_SLOW_STEPS;
    r->n_iter = r->iteration;
    r->found = (r->found & IK_HELD) | (reached ? IK_REACHED : 0) | (rests ? IK_AT_REST : 0);
    if (reached || rests || r->iteration >= s->max_iter) {
        ik_settle(s, r);
        return;
    }
    /* Damping proportional to the error: the last iterations are Gauss-Newton steps. */
    const real trust = r->nu * (r->live.error / r->start);
    real moved[IK_ROWS];
    ik_step_bounds(&s->ik, r->live.q, R(0.0), NULL, &r->step);
    for (int j = 0; j < n; j++)
        if (s->ik.period[j] < R(INFINITY)) {
            r->step.upper[j] = R(0.5) * s->ik.period[j];
            r->step.lower[j] = -r->step.upper[j];
        }
    ik_limited_step(&s->ik, r->live.J, r->live.e, 0, &trust, &ik_no_rows, &r->step);
    IK_OF(m, ik_rows_of, n, r->live.J, r->step.dq, moved);
    for (int i = 0; i < m; i++) moved[i] = r->live.e[i] - moved[i];
    r->predicted = ik_norm(m, moved);
    r->found &= ~IK_HELD;
    for (int j = 0; j < n; j++) r->found |= r->step.held[j] ? IK_HELD : 0;
    ik_ask(&s->ik, r, IK_LOWER);
}

static void ik_lowered(const ik_search_t *s, ik_row *r, const ik_point *now) {
    const real error = r->live.error, gained = error * error - now->error * now->error;
    const real hoped = error * error - r->predicted * r->predicted;
    const real quality = gained / (hoped < R(1e-30) ? R(1e-30) : hoped);
    const real u = R(2.0) * quality - R(1.0);
    const int better = now->error < error;
    /* The damping follows the ratio of actual to predicted gain. */
    r->nu *= better ? ik_clip(R(1.0) - u * u * u, R(1.0) / R(3.0), R(2.0)) : r->growth;
    r->growth = better ? R(2.0) : R(2.0) * r->growth;
    r->slow = better && error - now->error < IK_SLOW * s->tol[0] ? r->slow + 1 : 0;
    if (better) ik_keep(&s->ik, &r->live, now);
    r->iteration++;
    ik_lower_on(s, r);
}

/* What a step of a slide gained by the trapezoidal rule, and how much of the next one to take. */
static void ik_slid(const ik_search_t *s, ik_row *r, const ik_point *now) {
    const int n = s->ik.n, last = r->iteration == IK_NULL_STEPS - 1;
    const real *unit = s->ik.unit;
    real wish[HK_MAX_N], free[HK_MAX_N];
    real gain = R(0.0), bend = R(0.0), square = R(0.0), left = R(0.0);
    ik_wish(s, now, wish, free);
    for (int j = 0; j < n; j++) {
        const real way = (now->q[j] - r->live.q[j]) / unit[j], want = r->wish[j] / unit[j];
        gain += R(0.5) * (r->free[j] + free[j]) / unit[j] * way;
        bend += way * (r->free[j] - free[j]) / unit[j];
        square += way * way;
        left += want * want;
    }
    const real slip = IK_NULL_SLIP * ik_norm(s->ik.m * n, r->live.J) * ik_norm(n, r->step.dq);
    const int reached = ik_reached(s, &r->live), reached_now = ik_reached(s, now);
    int ok = ((now->error <= slip || reached_now) && gain > R(0.0)) || last;
    ok |= !reached && now->error < R(0.5) * r->live.error;
    ok &= now->distance <= R(1.0) || !r->inside;
    const int far = gain > IK_NULL_GAIN * left || !reached || !reached_now;
    const int going = ok ? far : r->share > R(0.01);
    r->n_iter++, r->iteration++;
    if (ok) {
        const real curvature = bend / square;
        r->share =
            ik_clip(curvature > R(0.0) ? R(1.0) / curvature : R(2.0) * r->share, R(0.1), R(4.0));
        ik_keep(&s->ik, &r->live, now);
        for (int j = 0; j < n; j++) r->wish[j] = wish[j], r->free[j] = free[j];
        if (reached_now) ik_keep(&s->ik, &r->best, now);
    } else
        r->share *= R(0.25);
    ik_slide_on(s, r, going && !last ? IK_SLIDE : IK_POLISH);
}

/* Process the model's result at the requested configuration of a row. */
static void ik_take(const ik_search_t *s, ik_row *r, const ik_point *now) {
    switch (r->phase) {
    case IK_FIRST:
        ik_keep(&s->ik, &r->live, now);
        r->start = now->error;
        r->nu = R(1.0), r->growth = R(2.0), r->slow = 0, r->iteration = 0, r->n_iter = 0;
        r->found = ik_reached(s, now) ? IK_REACHED : 0;
        s->mode &IK_LOWERS ? ik_lower_on(s, r) : ik_settle(s, r);
        break;
    case IK_LOWER: ik_lowered(s, r, now); break;
    case IK_SLIDE: ik_slid(s, r, now); break;
    default:
        if (now->error < r->best.error && ik_reached(s, now)) ik_keep(&s->ik, &r->best, now);
        r->phase = IK_DONE;
    }
}

/* Memory of a search besides that of the model: q, x, J, then the rows. */
#define IK_ROW_LANES (int)((sizeof(ik_row) * HK_LANES + sizeof(V) - 1) / sizeof(V))
#define IK_SEARCH_WORK(n) ((n) + IK_ROWS + IK_ROWS * (n) + IK_ROW_LANES)

/* x (width) of one lane: a tip and its axes, or points. */
static inline void ik_lane(const ik_settings *ik, int lane, const V *vx, const V *turn, real *x) {
    real tip[3], axes[9];
    if (IK_IS_POSE(ik) || IK_IS_AXIS(ik)) {
        for (int j = 0; j < 3; j++) tip[j] = vx[j][lane];
        for (int j = 0; j < 9; j++) axes[j] = turn[j][lane];
        ik_pose_of(ik, tip, axes, x);
    } else
        for (int j = 0; j < ik->m; j++) x[j] = vx[j][lane];
}

/* The task at rows q (rows, n), for its rows x (rows, width) and J (rows, m, n). */
static void ik_look_at(const ik_settings *ik, int64_t rows, const real *q, real *x, real *J) {
    const int n = ik->n, m = ik->m;
    V *work = hkv_aligned(ik->work), turn[9];
    V *vq = hkv_take(&work, n), *vx = hkv_take(&work, m), *vJ = hkv_take(&work, m * n);
    for (int64_t r = 0; r < rows; r += HK_LANES) {
        const int count = (int)(rows - r < HK_LANES ? rows - r : HK_LANES);
        EACH(i)
            for (int j = 0; j < n; j++) vq[j][i] = q[(r + (i < count ? i : count - 1)) * n + j];
        if (IK_IS_POSE(ik) || IK_IS_AXIS(ik))
            hkv_pose(&ik->plan, ik->model, vq, vx, turn, vJ, NULL, work);
        else
            hkv_model(&ik->plan, ik->model, vq, vx, vJ, NULL, work);
        for (int i = 0; i < count; i++, x += ik->width, J += m * n) {
            ik_lane(ik, i, vx, turn, x);
            for (int j = 0; j < m * n; j++) J[j] = vJ[j][i];
            ik_task_rows(ik, x, J);
        }
    }
}

/* Search `rows` rows from q (rows, n), which becomes the best configurations; J (rows, m, n) there,
   errors e (rows, m), what was found (rows), and the iterations (rows). */
static void ik_search(ik_search_t *s, int64_t rows, const real *target, real *q, real *J, real *e,
                      int32_t *found, int32_t *n_iter) {
    const int n = s->ik.n, m = s->ik.m, width = s->ik.width;
    const hk_plan plan = {s->ik.plan.code, s->ik.plan.data, R(1.0)}; /* inside is inside */
    V *work = hkv_aligned(s->ik.work), turn[9], distance = SPLAT(0.0);
    V *vq = hkv_take(&work, n), *vx = hkv_take(&work, m), *vJ = hkv_take(&work, m * n);
    ik_row *lane = (ik_row *)hkv_take(&work, IK_ROW_LANES);
    ik_point now;
    int64_t next = 0;
    int busy = 0;
    for (int j = 0; j < n; j++) vq[j] = SPLAT(0.0);
    s->ik.work = (real *)work;
    s->ik.quick = 1;
    EACH(i) lane[i].phase = IK_DONE;
    do {
        EACH(i) {
            ik_row *r = lane + i;
            if (r->phase == IK_DONE && next < rows) {
                for (int j = 0; j < n; j++) r->live.q[j] = q[next * n + j];
                for (int j = 0; j < width; j++) r->target[j] = target[next * width + j];
                for (int j = 0; j < n; j++) r->step.dq[j] = R(0.0);
                r->row = next++, busy++;
                ik_ask(&s->ik, r, IK_FIRST);
            }
            if (r->phase != IK_DONE)
                for (int j = 0; j < n; j++) vq[j][i] = r->ask[j];
        }
        if (!busy) return;
        if (IK_IS_POSE(&s->ik) || IK_IS_AXIS(&s->ik))
            hkv_pose(&plan, s->ik.model, vq, vx, turn, vJ, &distance, work);
        else
            hkv_model(&plan, s->ik.model, vq, vx, vJ, &distance, work);
        EACH(i) {
            ik_row *r = lane + i;
            real x[IK_WIDTH];
            if (r->phase == IK_DONE) continue;
            for (int j = 0; j < n; j++) now.q[j] = r->ask[j];
            for (int j = 0; j < m * n; j++) now.J[j] = vJ[j][i];
            ik_lane(&s->ik, i, vx, turn, x);
            ik_difference(&s->ik, x, r->target, now.e);
            ik_task_rows(&s->ik, x, now.J);
            ik_in_plane(&s->ik, m, now.J);
            now.error = ik_norm(m, now.e), now.distance = distance[i];
            ik_take(s, r, &now);
            if (r->phase != IK_DONE) continue;
            busy--;
            for (int j = 0; j < n; j++) q[r->row * n + j] = r->best.q[j];
            for (int j = 0; j < m * n; j++) J[r->row * m * n + j] = r->best.J[j];
            for (int j = 0; j < m; j++) e[r->row * m + j] = r->best.e[j];
            found[r->row] = r->found;
            n_iter[r->row] = r->n_iter;
        }
    } while (busy || next < rows);
}
