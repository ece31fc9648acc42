/* x = f(q) + sum_k w_k s_k(q) + t(q) d(q): a mechanical model f, corrections s_k in front of the
   tip or inside the robot, each faded and shortened by its guard, and a drift d with its trust t.
 */

/* What all corrections of a row add to. C and its own `pull` hold df/dq in inner coordinates. */
typedef struct {
    V *x, *J;        /* x (m), and dx/dq without what C brings, or NULL */
    int has_J;       /* whether J holds any of it yet */
    V *z, f[3];      /* inner coordinates (k) of q, and their tip */
    V *C0;           /* df/dz (3, k), if it was needed */
    V *C;            /* the total derivative (3, k) by z */
    V trust, *slope; /* of the drift, (n) */
    V farthest;      /* distance of any guard */
    int has_C0, fades, measures; /* whether `farthest` is asked for */
    HK(inside) in;
    HK(seen) seen;
} HK(total);

/* What the sum takes, then the largest of its terms: at the tip, inside, and what they call. */
#define HK_SUM_WORK(n, S, m, features)                                                             \
    ((m) + 7 * HK_MOST_Z(n, S) + (n) + HK_INSIDE_WORK(n, S) + HK_SEEN_WORK(n, features))
#define HK_TERM_WORK(n, S, m)                                                                      \
    ((m) * ((n) + 2) > HK_MOST_Z(n, S) * ((n) + 4) + 3 * (n) + 3                                   \
         ? (m) * ((n) + 2)                                                                         \
         : HK_MOST_Z(n, S) * ((n) + 4) + 3 * (n) + 3)
#define HK_HYBRID_WORK(n, S, m, features)                                                          \
    (HK_USES(HK_HYBRID) * (HK_SUM_WORK(n, S, m, features) + HK_TERM_WORK(n, S, m) + (n) +          \
                           HK_GUARD_WORK(n, S, m)))

/* df/dz, computed once. */
static inline const V *HK(base_slope)(const hk_plan *p, int base, HK(total) * sum, V *work) {
    V f[3];
    if (!sum->has_C0) HK(from_coordinates)(p, base, sum->z, f, sum->C0, work);
    sum->has_C0 = 1;
    return sum->C0;
}

/* Fades x (m) and its derivatives: J (m, k) by q with the slope (n = k), or any D (m, k) without.
 */
static inline void HK(fade)(int m, int k, V g, const V *slope, const V *x, V *J) {
    for (int i = 0; i < m; i++)
        for (int j = 0; j < k; j++) {
            J[k * i + j] = J[k * i + j] * g;
            if (slope) J[k * i + j] = J[k * i + j] + x[i] * slope[j];
        }
}

/* Where a correction writes its slope: where the sum stands, if it is the first one. */
static inline V *HK(first_or)(const HK(total) * sum, V *own) { return sum->has_J ? own : sum->J; }

/* Adds w times that slope. */
static inline void HK(add_slope)(int length, real w, const V *J, HK(total) * sum) {
    if (sum->has_J)
        HK(add)(length, w, J, sum->J);
    else
        for (int i = 0; w != R(1.0) && i < length; i++) sum->J[i] = sum->J[i] * w;
    sum->has_J = 1;
}

/* The guard's weight of a correction; keeps its part of trust and domain. */
static inline int HK(guarded)(const hk_plan *p, int guard, const V *q, real w, HK(total) * sum,
                              V *g, V *slope, V *work) {
    V distance;
    if (guard < 0) return 0;
    const int fades =
        HK(fading)(p, guard, sum->measures, q, &sum->seen, &distance, g, sum->J ? slope : NULL, work);
    /* NaN is the farthest. */
    sum->farthest = SELECT(NOT(distance <= sum->farthest), distance, sum->farthest);
    if (!fades) return 0;
    sum->trust = sum->trust - w * (R(1.0) - *g);
    for (int j = 0; sum->J && j < p->code[guard + HK_N]; j++)
        sum->slope[j] = (sum->fades ? sum->slope[j] : SPLAT(0.0)) + w * slope[j];
    sum->fades = 1;
    return 1;
}

/* Adds a correction at the tip, w s(q). */
static inline void HK(tip_correction)(const hk_plan *p, const int32_t *part, const V *q, int m,
                                      real w, HK(total) * sum, V *work) {
    const int at = part[HK_REGRESSOR], guard = part[HK_GUARD], n = p->code[at + HK_N];
    const int own =
        guard >= 0 && HK_IS(p, guard, HK_LEVERAGE_GUARD) && p->code[guard + HK_MORE] == at;
    V *x = HK(take)(&work, m), *J = HK(take)(&work, m * n), *slope = HK(take)(&work, n), g;
    HK(shortening) how;
    how.along = HK(take)(&work, m);
    J = HK(first_or)(sum, J);
    HK(regress)(p, at, q, x, sum->J ? J : NULL, own ? sum->seen.phi : NULL, work);
    if (own) sum->seen.phi_of = at;
    if (HK(guarded)(p, guard, q, w, sum, &g, slope, work)) {
        if (sum->J) HK(fade)(m, n, g, slope, x, J);
        for (int i = 0; i < m; i++) x[i] = x[i] * g;
    }
    if (guard >= 0 && HK(is_long)(p, guard, m, x, &how)) {
        if (sum->J) HK(shorten)(&how, m, n, J);
        for (int i = 0; i < m; i++) x[i] = x[i] * how.factor;
    }
    HK(add)(m, w, x, sum->x);
    if (sum->J) HK(add_slope)(m * n, w, J, sum);
}

/* Adds a correction inside the robot, w (f + s(q)) with s = F(z + delta(q)) - f. Rows that fade or
   are too long need df/dz as well. All is linear in the columns, so one `pull` at the end serves
   all corrections: C takes what multiplies dz/dq, J the rest. */
static inline void HK(inner_correction)(const hk_plan *p, int base, const int32_t *part, const V *q,
                                        real w, HK(total) * sum, V *work) {
    const int guard = part[HK_GUARD], n = p->code[base + HK_N], k = HK(n_coordinates)(p, base);
    V *z = HK(take)(&work, k), *turn = HK(take)(&work, k * n), *C = HK(take)(&work, 3 * k);
    V *J = HK(take)(&work, 3 * n), *slope = HK(take)(&work, n), along[3], x[3], g;
    HK(shortening) how;
    how.along = along;
    J = HK(first_or)(sum, J);
    HK(regress)(p, part[HK_REGRESSOR], q, z, sum->J ? turn : NULL, NULL, work);
    for (int i = 0; i < k; i++) z[i] = z[i] + sum->z[i];
    HK(from_coordinates)(p, base, z, x, sum->J ? C : NULL, work);
    if (HK_COMMON(sum->J && n == 9 && k == 9))
        HK(multiply)(9, 9, C, turn, J);
    else if (sum->J)
        HK(multiply)(k, n, C, turn, J);
    if (guard >= 0) {
        for (int i = 0; i < 3; i++) x[i] = x[i] - sum->f[i];
        const int fades = HK(guarded)(p, guard, q, w, sum, &g, slope, work);
        V own[3] = {x[0], x[1], x[2]};
        for (int i = 0; fades && i < 3; i++) own[i] = own[i] * g;
        const int too_long = HK(is_long)(p, guard, 3, own, &how);
        if (sum->J && (fades || too_long)) {
            const V *C0 = HK(base_slope)(p, base, sum, work);
            for (int i = 0; i < 3 * k; i++) C[i] = C[i] - C0[i];
            if (fades) HK(fade)(3, k, g, NULL, x, C);
            if (fades) HK(fade)(3, n, g, slope, x, J);
            if (too_long) HK(shorten)(&how, 3, k, C);
            if (too_long) HK(shorten)(&how, 3, n, J);
            for (int i = 0; i < 3 * k; i++) C[i] = C[i] + C0[i];
        }
        for (int i = 0; i < 3; i++) x[i] = sum->f[i] + (too_long ? own[i] * how.factor : own[i]);
    }
    HK(add)(3, w, x, sum->x);
    if (sum->J) HK(add)(3 * k, w, C, sum->C);
    if (sum->J) HK(add_slope)(3 * n, w, J, sum);
}

static inline void HK(hybrid)(const hk_plan *p, int at, const V *q, V *x, V *J, V *distance,
                              V *work) {
    const int32_t *node = p->code + at, *more = node + HK_MORE, *part = more + HK_FIRST;
    const int n = node[HK_N], m = node[HK_M], base = more[HK_BASE], count = more[HK_COUNT];
    const real *w = hk_numbers(p, at), share = w[count]; /* of f beside inner corrections */
    const int inner = w[count + 1] != R(0.0), k = base < 0 ? 0 : HK(n_coordinates)(p, base);
    HK(total) sum;
    sum.x = HK(take)(&work, m);
    sum.J = J;
    sum.z = HK(take)(&work, k);
    sum.C0 = HK(take)(&work, 3 * k);
    sum.C = HK(take)(&work, 3 * k);
    sum.slope = HK(take)(&work, n);
    if (base >= 0) sum.in = HK(inside_of)(p, base, &work);
    sum.seen = HK(seen_of)(p, &work);
    sum.has_J = sum.has_C0 = sum.fades = 0;
    sum.measures = distance != NULL;
    sum.trust = SPLAT(1.0);
    sum.farthest = SPLAT(0.0);
    for (int i = 0; i < m; i++) sum.x[i] = SPLAT(0.0);
    if (base >= 0) HK(coordinates)(p, base, q, sum.z, &sum.in);
    if (inner) {
        HK(from_coordinates)(p, base, sum.z, sum.f, NULL, work);
        HK(add)(3, share, sum.f, sum.x);
        for (int i = 0; i < 3 * k; i++) sum.C[i] = SPLAT(0.0);
        if (J && share != R(0.0)) HK(add)(3 * k, share, HK(base_slope)(p, base, &sum, work), sum.C);
    } else if (base >= 0)
        HK(from_coordinates)(p, base, sum.z, sum.x, J ? sum.C : NULL, work);
    for (int c = 0; c < count; c++, part += HK_STRIDE)
        if (part[HK_INNER])
            HK(inner_correction)(p, base, part, q, w[c], &sum, work);
        else
            HK(tip_correction)(p, part, q, m, w[c], &sum, work);
    for (int i = 0; J && !sum.has_J && i < m * n; i++) J[i] = SPLAT(0.0);
    if (base >= 0 && J) HK(pull)(p, base, &sum.in, sum.C, J);
    if (more[HK_DRIFT] >= 0) {
        V *d = HK(take)(&work, m), *slope = HK(take)(&work, m * n);
        HK(regress)(p, more[HK_DRIFT], q, d, J ? slope : NULL, NULL, work);
        if (J) HK(fade)(m, n, sum.trust, sum.fades ? sum.slope : NULL, d, slope);
        for (int i = 0; i < m; i++) sum.x[i] = sum.x[i] + d[i] * sum.trust;
        if (J) HK(add)(m * n, R(1.0), slope, J);
    }
    for (int i = 0; i < m; i++) x[i] = sum.x[i];
    if (!distance) return;
    *distance = sum.farthest;
    if (more[HK_TESTED] < 0) return;
    const V here = HK(group_distance)(p, more[HK_TESTED], q, NULL, work);
    *distance = SELECT(NOT(here <= *distance), here, *distance);
}

/* The largest distance of any guard and of the groups, and its slope (n) by q where not NULL. */
static inline void HK(farthest)(const hk_plan *p, int at, const V *q, V *distance, V *slope,
                                V *work) {
    const int32_t *node = p->code + at, *part = node + HK_MORE + HK_FIRST;
    const int n = node[HK_N], count = HK_IS(p, at, HK_HYBRID) ? node[HK_MORE + HK_COUNT] : 0;
    V *own = HK(take)(&work, n);
    HK(seen) seen = HK(seen_of)(p, &work);
    *distance = SPLAT(0.0);
    for (int j = 0; slope && j < n; j++) slope[j] = SPLAT(0.0);
    for (int c = 0; c < count; c++, part += HK_STRIDE) {
        if (part[HK_GUARD] < 0) continue;
        const real enough = slope ? R(0.0) : p->enough;
        const V here = HK(guard_distance)(p, part[HK_GUARD], enough, q, &seen, work);
        const M farther = NOT(here <= *distance);
        *distance = SELECT(farther, here, *distance);
        if (!slope || !HK(any)(farther)) continue;
        HK(guard_slope)(p, part[HK_GUARD], q, &seen, own, work);
        for (int j = 0; j < n; j++) slope[j] = SELECT(farther, own[j], slope[j]);
    }
    if (HK_IS(p, at, HK_HYBRID) && node[HK_MORE + HK_TESTED] >= 0) {
        const V here =
            HK(group_distance)(p, node[HK_MORE + HK_TESTED], q, slope ? own : NULL, work);
        const M farther = NOT(here <= *distance);
        *distance = SELECT(farther, here, *distance);
        for (int j = 0; slope && j < n; j++) slope[j] = SELECT(farther, own[j], slope[j]);
    }
}
