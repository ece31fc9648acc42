/* What keeps a robot still where its target is out of reach, and moves it where it is not: the curvature
   of the model along the last steps, and ways out of singular configurations. */

/* Numbers of what is remembered of the last step. */
#define IK_REST_SIZE(m) (IK_PROMISED + 2 * (m))

/* The range of an actuator, at most its period; 1 if it has none. */
static inline real ik_span(const ik_settings *ik, int j) {
    const real range = ik->high[j] - ik->low[j];
    const real span = range < ik->period[j] ? range : ik->period[j];
    return span < R(INFINITY) ? span : R(1.0);
}

/* Take out of a direction u (n) what moves the tip, where it can move well, and what the plane forbids,
   or a sign that is not open; make it a unit vector. */
static HK_NOINLINE void ik_allow(const ik_settings *ik, const real *J, const ik_factors *f,
                            const unsigned char *up, const unsigned char *down, real *u) {
    const int n = ik->n, m = ik->m;
    real moved[IK_ROWS] = {R(0.0)}, mu[IK_ROWS];
    ik_motion(ik, J, u, moved);
    ik_solve(m, f, moved, mu);
    for (int i = 0; i < m; i++) mu[i] = -mu[i];
    ik_columns_of(m, n, J, mu, u, u);
    ik_in_plane(ik, 1, u);
    for (int j = 0; j < n; j++)
        if (u[j] > R(0.0) ? !up[j] : !down[j]) u[j] = R(0.0);
    const real size = ik_norm(n, u);
    for (int j = 0; j < n && size > R(0.0); j++) u[j] /= size;
}

/* Leave a configuration in which the error e is lost, eq. (22): if the second derivative of the model
   moves the tip towards the target along a direction, go there. Where the target is out of reach
   there is none. */
static HK_NOINLINE void ik_escape(const ik_settings *ik, const real *q, const real *J,
                                  const real *e, ik_step_t *s) {
    const int n = ik->n, m = ik->m;
    real *there = ik_slot(ik, IK_END), bent[HK_MAX_N * HK_MAX_N], g[IK_PAIRS], at[HK_MAX_N];
    real x[IK_WIDTH], u[HK_MAX_N], next[HK_MAX_N], spans[HK_MAX_N], moved[IK_ROWS] = {R(0.0)};
    unsigned char up[HK_MAX_N], down[HK_MAX_N];
    ik_factors f;
    ik_products(m, n, J, NULL, g);
    const real largest = ik_trace(m, g);
    ik_factor(m, g, IK_HEALTHY * IK_HEALTHY * largest, &f);
    for (int j = 0; j < n; j++) {
        spans[j] = ik_span(ik, j);
        at[j] = q[j];
        /* Open is what the bounds allow, and what does not raise the error to first order. */
        real slope = R(0.0), size = R(0.0);
        for (int i = 0; i < m; i++) {
            slope += J[n * i + j] * e[i];
            size += J[n * i + j] * J[n * i + j];
        }
        const real flat = IK_FLAT * HK_MATH(sqrt)(size) * ik_norm(m, e);
        up[j] = s->upper[j] > R(0.0) && slope >= -flat;
        down[j] = s->lower[j] < R(0.0) && slope <= flat;
        /* A start with a part of each direction. */
        u[j] = (j % 2 ? -R(1.0) : R(1.0)) / (R(1.0) + (real)j);
        if (!(up[j] && down[j])) u[j] = up[j] ? ik_abs(u[j]) : -ik_abs(u[j]);
    }
    /* The second derivative of x along e, by differences inwards. */
    for (int j = 0; j < n; j++) {
        const real probe = (s->upper[j] > R(0.0) ? IK_PROBE : -IK_PROBE) * spans[j];
        at[j] = q[j] + probe;
        ik_look(ik, at, x, there);
        at[j] = q[j];
        for (int l = 0; l < n; l++) {
            bent[n * j + l] = R(0.0);
            for (int i = 0; i < m; i++)
                bent[n * j + l] += e[i] * (there[n * i + l] - J[n * i + l]) / probe;
        }
    }
    const real seen = ik_norm(n * n, bent);
    ik_allow(ik, J, &f, up, down, u);
    for (int turn = 0; turn < IK_TURNS; turn++) {
        for (int j = 0; j < n; j++) {
            next[j] = seen * u[j];
            for (int l = 0; l < n; l++) next[j] += R(0.5) * (bent[n * j + l] + bent[n * l + j]) * u[l];
        }
        for (int j = 0; j < n; j++) u[j] = next[j];
        ik_allow(ik, J, &f, up, down, u);
    }
    real curved = R(0.0), length = R(INFINITY);
    ik_motion(ik, J, u, moved);
    for (int i = 0; i < m; i++) curved -= moved[i] * moved[i];
    for (int j = 0; j < n; j++)
        for (int l = 0; l < n; l++) curved += u[j] * bent[n * j + l] * u[l];
    if (!(curved > IK_BENDS * largest && curved > IK_BENDS_MOST * seen)) return;
    /* As far as this curvature takes back the error, within limits. */
    for (int j = 0; j < n; j++) {
        const real left = u[j] > R(0.0) ? s->upper[j] - s->dq[j] : s->dq[j] - s->lower[j];
        const real way = IK_WAY_OUT * spans[j], most = (left < way ? left : way) / ik_abs(u[j]);
        length = most < length ? most : length;
    }
    const real whole = ik_norm(m, e) * HK_MATH(sqrt)(R(2.0) / curved);
    length = whole < length ? whole : length;
    for (int j = 0; j < n; j++) {
        s->dq[j] = ik_clip(s->dq[j] + length * u[j], s->lower[j], s->upper[j]);
        s->held[j] = (unsigned char)((s->dq[j] <= s->lower[j]) | (s->dq[j] >= s->upper[j]));
    }
}

/* Read the curvature of the model from the errors before and after the last step, eq. (21), and
   return the least lambda^2 of this one. It grows where more than half of the promised change of the
   squared error did not come true: to what is missing per squared step. It eases where less than a
   quarter is missing, after steps that are longer than rounding or show far less of it. */
static inline real ik_rest(const ik_settings *ik, const real *J, const real *before, const real *e,
                           real *rest) {
    real start = R(0.0), end = R(0.0), left = R(0.0), motion = R(0.0), jump = R(0.0);
    real largest = R(0.0), bent = rest[IK_BENT];
    for (int i = 0; i < ik->m; i++) {
        const real move = rest[IK_PROMISED + i], stays = before[i] - move;
        const real apart = before[i] - rest[IK_PROMISED + ik->m + i];
        start += before[i] * before[i], end += e[i] * e[i];
        motion += move * move, left += stays * stays, jump += apart * apart;
    }
    const real fall = start - end, promised = start - left, missing = promised - fall;
    const real none = hk_larger(IK_NO_FALL, R(32.0) * HK_EPS);
    const int tells = rest[IK_SHARE] > IK_NO_WAY && jump <= IK_JUMP * IK_JUMP * start &&
                      hk_larger(ik_abs(promised), ik_abs(fall)) > none * start;
    const int weak = tells && missing > R(0.5) * ik_abs(promised);
    if (!(weak || bent > R(0.0)) || !(end > R(0.0))) return R(0.0);
    for (int i = 0; i < ik->m; i++)
        for (int j = 0; j < ik->n; j++) {
            const real own = J[i * ik->n + j] * ik->unit[j];
            largest += own * own;
        }
    const real size = HK_MATH(sqrt)(end), bend = (end - left) / rest[IK_WAY_SQ];
    const real here = bend / size, eased = IK_EASED * bent;
    if (weak && bend > IK_CURVED * largest)
        bent = hk_larger(here, bent);
    else if (tells && missing < R(0.25) * ik_abs(promised) &&
             (rest[IK_SHARE] > IK_EASED_WAY || here < IK_STRAIGHT * bent))
        /* Where it exceeds J^T J along the step, a longer one would not have kept its promise. */
        bent = missing > R(0.5) * motion ? ik_clip(here, eased, bent) : eased;
    if (bent * size > IK_MOST_CURVED * largest) bent = IK_MOST_CURVED * largest / size;
    if (bent * size < IK_CURVED * largest) bent = R(0.0);
    if (ik_finite(1, &bent)) rest[IK_BENT] = bent;
    bent = rest[IK_BENT] * size;
    return ik_finite(1, &bent) ? bent : R(0.0);
}

/* Remember a step of where the model is, the motion of the tip that it promised, and the error that
   it was made for. */
static inline void ik_remember(const ik_settings *ik, const real *from, const real *to,
                               const real *promised, const real *e, real *rest) {
    rest[IK_WAY_SQ] = rest[IK_SHARE] = R(0.0);
    for (int j = 0; j < ik->n; j++) {
        const real way = to[j] - from[j], own = way / ik->unit[j];
        rest[IK_WAY_SQ] += own * own;
        rest[IK_SHARE] = hk_larger(ik_abs(way) / ik_span(ik, j), rest[IK_SHARE]);
    }
    for (int i = 0; i < ik->m; i++) {
        rest[IK_PROMISED + i] = promised[i];
        rest[IK_PROMISED + ik->m + i] = e[i];
    }
}
