/* The search for configurations that reach positions, one row per target, HK_LANES rows at a time.

   A row is a small machine: it asks for the model at a configuration, and takes what comes. */

enum { IK_NULL_STEPS = 30, IK_SLOW_STEPS = 8 };
#define IK_LAST_DAMPING R(1e8) /* no descent even with this one: as good as it gets */
#define IK_STATIONARY R(1e-4)  /* sine of the angle between error and what the limits leave free */
#define IK_NULL_SLIP R(0.3)    /* error per tip-sized motion that the next null-space step mends */
#define IK_NULL_GAIN R(1e-8)   /* of the square of what is left to go; below it a descent ends */
#define IK_INSIDE R(0.98)      /* domain distance to go to from outside the domain */

/* What to do: lower the error; where it is reached, slide into the domain, or to the posture. */
enum { IK_LOWERS = 1, IK_TO_DOMAIN = 2, IK_TO_POSTURE = 4 };
enum { IK_REACHED = 1, IK_AT_REST = 2, IK_HELD = 4 };
enum { IK_FIRST, IK_LOWER, IK_SLIDE, IK_POLISH, IK_DONE };

typedef struct {
    real q[HK_MAX_N], J[3 * HK_MAX_N], e[3], error, distance;
} ik_point;

typedef struct {
    int64_t row;
    int phase, iteration, n_iter, found, inside;
    real start, nu, growth, predicted, share; /* of the descent, and of the slide */
    real target[3], ask[HK_MAX_N], wish[HK_MAX_N], free[HK_MAX_N];
    int slow;
    ik_point live, best;
    ik_step_t step;
} ik_row;

typedef struct {
    ik_settings ik;
    int mode, max_iter;
    real tol;
} ik_search_t;

static inline void ik_ask(ik_row *r, int n, int phase, int stays) {
    r->phase = phase;
    for (int j = 0; j < n; j++) r->ask[j] = r->live.q[j] + (stays ? R(0.0) : r->step.dq[j]);
}

/* Whether no motion within the limits lowers the error to first order. */
static inline int ik_blocked(const ik_settings *ik, const ik_point *at) {
    const int n = ik->n, limited = ik->flags & IK_LIMITED;
    real left = R(0.0), pull[HK_MAX_N];
    for (int j = 0; j < n; j++) pull[j] = R(0.0);
    ik_columns_of(n, at->J, at->e, pull, pull);
    for (int j = 0; j < n; j++) {
        const int out = limited && ((at->q[j] >= ik->high[j] && pull[j] > R(0.0)) ||
                                    (at->q[j] <= ik->low[j] && pull[j] < R(0.0)));
        left += out ? R(0.0) : pull[j] * pull[j];
    }
    return HK_MATH(sqrt)(left) <= IK_STATIONARY * ik_norm(3 * n, at->J) * at->error;
}

/* The wanted step of a slide from a point, and its part that does not move the tip. */
static void ik_wish(const ik_search_t *s, const ik_point *at, real *wish, real *free) {
    const ik_settings *ik = &s->ik;
    const int n = ik->n;
    real J[3 * HK_MAX_N], g[6];
    if (s->mode & IK_TO_DOMAIN) { /* Newton's step of the domain distance */
        real distance, square = R(0.0);
        hk_domain(&ik->plan, ik->model, at->q, &distance, wish);
        for (int j = 0; j < n; j++) square += wish[j] * wish[j];
        const real beyond = distance - IK_INSIDE;
        const real share = (beyond < R(0.0) ? R(0.0) : beyond) / (square > R(0.0) ? square : R(1.0));
        for (int j = 0; j < n; j++) wish[j] = -share * wish[j];
    } else
        for (int j = 0; j < n; j++) wish[j] = ik->posture[j] - at->q[j];
    for (int j = 0; j < n; j++) {
        for (int i = 0; i < 3; i++) J[n * i + j] = at->J[n * i + j] * ik->unit[j];
        free[j] = wish[j] / ik->unit[j];
    }
    ik_products(n, J, NULL, g);
    ik_null_projection(n, J, g, free);
    for (int j = 0; j < n; j++) free[j] *= ik->unit[j];
}

/* Ask for the next point of a slide: a share of the free step; at the end what lies at a limit is
   held, and only the error counts. */
static void ik_slide_on(const ik_search_t *s, ik_row *r, int phase) {
    const int n = s->ik.n, slides = phase == IK_SLIDE && r->iteration < IK_NULL_STEPS - 1;
    if (phase == IK_POLISH) r->live = r->best;
    ik_step_bounds(&s->ik, r->live.q, R(0.0), NULL, &r->step);
    for (int j = 0; j < n; j++) {
        real *lower = r->step.lower + j, *upper = r->step.upper + j;
        r->step.posture[j] = r->share * r->free[j];
        if (phase == IK_POLISH && (*lower >= R(0.0) || *upper <= R(0.0))) *lower = *upper = R(0.0);
    }
    ik_limited_step(&s->ik, r->live.J, r->live.e, slides, NULL, &r->step);
    ik_ask(r, n, phase, 0);
}

/* From here a row slides, or is done. */
static void ik_settle(const ik_search_t *s, ik_row *r) {
    const int outside = r->live.distance > R(1.0);
    r->best = r->live;
    r->phase = IK_DONE;
    if (!(r->found & IK_REACHED)) return;
    if (!(s->mode & IK_TO_POSTURE) && !((s->mode & IK_TO_DOMAIN) && outside)) return;
    r->inside = !outside, r->iteration = 0, r->share = R(1.0);
    ik_wish(s, &r->live, r->wish, r->free);
    ik_slide_on(s, r, IK_SLIDE);
}

/* Levenberg and Marquardt: ask for the next point, or settle. */
static void ik_lower_on(const ik_search_t *s, ik_row *r) {
    const int n = s->ik.n, reached = r->live.error <= s->tol;
    const int rests = ik_blocked(&s->ik, &r->live) || r->nu > IK_LAST_DAMPING ||
                      r->slow >= IK_SLOW_STEPS;
    r->n_iter = r->iteration;
    r->found = (r->found & IK_HELD) | (reached ? IK_REACHED : 0) | (rests ? IK_AT_REST : 0);
    if (reached || rests || r->iteration >= s->max_iter) {
        ik_settle(s, r);
        return;
    }
    /* Damping in proportion to the error, so that the last iterations are Gauss-Newton's. */
    const real trust = r->nu * (r->live.error / r->start);
    real moved[3];
    ik_step_bounds(&s->ik, r->live.q, R(0.0), NULL, &r->step);
    ik_limited_step(&s->ik, r->live.J, r->live.e, 0, &trust, &r->step);
    ik_rows_of(n, r->live.J, r->step.dq, moved);
    for (int i = 0; i < 3; i++) moved[i] = r->live.e[i] - moved[i];
    r->predicted = ik_norm(3, moved);
    r->found &= ~IK_HELD;
    for (int j = 0; j < n; j++) r->found |= r->step.held[j] ? IK_HELD : 0;
    ik_ask(r, n, IK_LOWER, 0);
}

static void ik_lowered(const ik_search_t *s, ik_row *r, const ik_point *now) {
    const real error = r->live.error, gained = error * error - now->error * now->error;
    const real hoped = error * error - r->predicted * r->predicted;
    const real quality = gained / (hoped < R(1e-30) ? R(1e-30) : hoped);
    const real u = R(2.0) * quality - R(1.0);
    const int better = now->error < error;
    /* The damping follows the share of the predicted gain that came true. */
    r->nu *= better ? ik_clip(R(1.0) - u * u * u, R(1.0) / R(3.0), R(2.0)) : r->growth;
    r->growth = better ? R(2.0) : R(2.0) * r->growth;
    r->slow = better && error - now->error < R(0.01) * s->tol ? r->slow + 1 : 0;
    if (better) r->live = *now;
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
    const real slip = IK_NULL_SLIP * ik_norm(3 * n, r->live.J) * ik_norm(n, r->step.dq);
    const int reached = r->live.error <= s->tol, reached_now = now->error <= s->tol;
    int ok = ((now->error <= slip || reached_now) && gain > R(0.0)) || last;
    ok |= !reached && now->error < R(0.5) * r->live.error;
    ok &= now->distance <= R(1.0) || !r->inside;
    const int far = gain > IK_NULL_GAIN * left || !reached || !reached_now;
    const int going = ok ? far : r->share > R(0.01);
    r->n_iter++, r->iteration++;
    if (ok) {
        const real curvature = bend / square;
        r->share = ik_clip(curvature > R(0.0) ? R(1.0) / curvature : R(2.0) * r->share, R(0.1),
                           R(4.0));
        r->live = *now;
        for (int j = 0; j < n; j++) r->wish[j] = wish[j], r->free[j] = free[j];
        if (reached_now) r->best = *now;
    } else
        r->share *= R(0.25);
    ik_slide_on(s, r, going && !last ? IK_SLIDE : IK_POLISH);
}

/* Take the model's answer at what the row asked for. */
static void ik_take(const ik_search_t *s, ik_row *r, const ik_point *now) {
    switch (r->phase) {
    case IK_FIRST:
        r->live = *now;
        r->start = now->error;
        r->nu = R(1.0), r->growth = R(2.0), r->slow = 0, r->iteration = 0, r->n_iter = 0;
        r->found = now->error <= s->tol ? IK_REACHED : 0;
        s->mode & IK_LOWERS ? ik_lower_on(s, r) : ik_settle(s, r);
        break;
    case IK_LOWER: ik_lowered(s, r, now); break;
    case IK_SLIDE: ik_slid(s, r, now); break;
    default:
        if (now->error < r->best.error) r->best = *now;
        r->phase = IK_DONE;
    }
}

/* Search `rows` rows from q (rows, n), which becomes the best configurations; J (rows, 3, n) there,
   errors e (rows, 3), what was found (rows), and the iterations (rows). */
static void ik_search(const ik_search_t *s, int64_t rows, const real *target, real *q, real *J,
                      real *e, int32_t *found, int32_t *n_iter) {
    const int n = s->ik.n;
    ik_row lane[HK_LANES];
    ik_point now;
    V vq[HK_MAX_N], vx[3], vJ[3 * HK_MAX_N], distance;
    int64_t next = 0;
    int busy = 0;
    for (int j = 0; j < n; j++) vq[j] = SPLAT(0.0);
    EACH(i) lane[i].phase = IK_DONE;
    do {
        EACH(i) {
            ik_row *r = lane + i;
            if (r->phase == IK_DONE && next < rows) {
                for (int j = 0; j < n; j++) r->live.q[j] = q[next * n + j];
                for (int j = 0; j < 3; j++) r->target[j] = target[next * 3 + j];
                r->row = next++, busy++;
                ik_ask(r, n, IK_FIRST, 1);
            }
            if (r->phase != IK_DONE)
                for (int j = 0; j < n; j++) vq[j][i] = r->ask[j];
        }
        if (!busy) return;
        hkv_model(&s->ik.plan, s->ik.model, vq, vx, vJ, &distance);
        EACH(i) {
            ik_row *r = lane + i;
            if (r->phase == IK_DONE) continue;
            for (int j = 0; j < n; j++) now.q[j] = r->ask[j];
            for (int j = 0; j < 3 * n; j++) now.J[j] = vJ[j][i];
            for (int j = 0; j < 3; j++) now.e[j] = r->target[j] - vx[j][i];
            now.error = ik_norm(3, now.e), now.distance = distance[i];
            ik_take(s, r, &now);
            if (r->phase != IK_DONE) continue;
            busy--;
            for (int j = 0; j < n; j++) q[r->row * n + j] = r->best.q[j];
            for (int j = 0; j < 3 * n; j++) J[r->row * 3 * n + j] = r->best.J[j];
            for (int j = 0; j < 3; j++) e[r->row * 3 + j] = r->best.e[j];
            found[r->row] = r->found;
            n_iter[r->row] = r->n_iter;
        }
    } while (busy || next < rows);
}
