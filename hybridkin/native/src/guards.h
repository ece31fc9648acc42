/* Where a correction is trusted: leverage, weights, and the longest correction. */

/* The features of a row and their share of the leverage; guards of one hybrid often share them. */
typedef struct {
    int phi_of, white_of; /* places of the models, -1: of none */
    V leverage, *phi, *white;
} HK(seen);

/* Features are written in whole groups; after those of a network stand its inputs. */
#define HK_SEEN_WORK(n, features) ((features) ? 2 * ((features) + (n) + HK_GROUP) : 0)

static inline HK(seen) HK(seen_of)(const hk_plan *p, V **work) {
    const int count = HK_SEEN_WORK(p->code[HK_MOST_N], p->code[HK_MOST_F]) / 2;
    HK(seen) seen = {-1, -1, SPLAT(0.0), HK(take)(work, count), HK(take)(work, count)};
    return seen;
}

/* The leverage of a model. */
static inline hk_factor HK(lever)(const hk_plan *p, int at) {
    const int32_t *node = p->code + at, *more = node + HK_MORE;
    const int n = node[HK_N], m = node[HK_M], network = HK_IS(p, at, HK_ELM);
    const int groups = network ? (more[0] + HK_GROUP - 1) / HK_GROUP : 0;
    const real *numbers = hk_numbers(p, at) + 2 * n + m + m * n + groups * HK_GROUP * (n + 1 + m);
    const int f = network ? more[2] : 2 * n + 1;
    hk_factor lever = {f, f, 0, numbers[0], numbers[1], numbers + 2, numbers + 2 + f};
    if (network) {
        lever.k = more[3];
        lever.full = more[4];
#ifndef HK_KINDS /* R may stand elsewhere in memory, so far from the numbers of the plan */
        if (more[5] || more[6]) lever.R = p->data + (more[5] + more[6] * ((int64_t)1 << 31));
#endif
    }
    return lever;
}

/* Columns `at` to `at + HK_GROUP` of R, and how many of their numbers are not zero. After the last
   column they repeat the first of them. */
static inline int HK(columns)(const hk_factor *lever, int at, const real **column) {
    const int f = lever->f, to = at + HK_GROUP;
    for (int l = 0; l < HK_GROUP; l++) column[l] = lever->R + f * (at + l < lever->k ? at + l : at);
    return lever->full || to > f ? f : to;
}

#if HK_LANES == 1 && defined(HK_ROW_LANES)
static void hkr_products(int rows, const real *const *column, const real *v, real *r);
#endif
#if HK_LANES > 1
/* The products r of a vector v (rows) with HK_GROUP columns, with lanes over the rows. */
static void hkr_products(int rows, const real *const *column, const real *v, real *r) {
    V sum[HK_GROUP];
    for (int l = 0; l < HK_GROUP; l++) sum[l] = SPLAT(0.0);
    int i = 0;
    for (; i + HK_LANES <= rows; i += HK_LANES) {
        const V some = HK(load)(v + i);
        for (int l = 0; l < HK_GROUP; l++) sum[l] = sum[l] + HK(load)(column[l] + i) * some;
    }
    for (int l = 0; l < HK_GROUP; l++) {
        r[l] = HK(sum)(sum[l]);
        for (int j = i; j < rows; j++) r[l] += column[l][j] * v[j];
    }
}
#endif

static inline void HK(products)(int rows, const real *const *column, const V *v, V *r) {
#if HK_LANES == 1 && defined(HK_ROW_LANES)
    hkr_products(rows, column, v, r);
#else
    V sum[HK_GROUP];
    for (int l = 0; l < HK_GROUP; l++) sum[l] = SPLAT(0.0);
    for (int i = 0; i < rows; i++)
        for (int l = 0; l < HK_GROUP; l++) sum[l] = sum[l] + v[i] * column[l][i];
    for (int l = 0; l < HK_GROUP; l++) r[l] = sum[l];
#endif
}

/* v = phi - center in place of the features phi; returns |v|^2. */
static inline V HK(centered)(const hk_factor *lever, V *phi) {
    V squares = SPLAT(0.0);
    for (int i = 0; i < lever->f; i++) {
        phi[i] = phi[i] - lever->center[i];
        squares = squares + phi[i] * phi[i];
    }
    return squares;
}

#if HK_LANES > 1
/* The same, with the products r of v with the first HK_FIRST_COLUMNS, in threes: so few places fit
   into registers. */
static inline V hkv_first_products(const hk_factor *lever, V *phi, V *r) {
    const int f = lever->f;
    const real *a = lever->R, *b = a + 3 * f, *c = b + 3 * f, *d = c + 3 * f;
    V squares = SPLAT(0.0), sum[HK_FIRST_COLUMNS];
    for (int l = 0; l < HK_FIRST_COLUMNS; l++) sum[l] = SPLAT(0.0);
    for (int i = 0; i < f; i++) {
        const V v = phi[i] - lever->center[i];
        phi[i] = v;
        squares = squares + v * v;
        for (int l = 0; l < 3; l++) {
            sum[l] = sum[l] + v * a[f * l + i];
            sum[3 + l] = sum[3 + l] + v * b[f * l + i];
            sum[6 + l] = sum[6 + l] + v * c[f * l + i];
            sum[9 + l] = sum[9 + l] + v * d[f * l + i];
        }
    }
    for (int l = 0; l < HK_FIRST_COLUMNS; l++) r[l] = sum[l];
    return squares;
}
#endif

/* The leverage of features phi, which become v, and its r in `white`. With a prior it only falls
   from column to column: returns 0 as soon as it is at most `enough` for all rows, else 1. */
static inline int HK(leverage)(const hk_factor *lever, real enough, V *phi, V *white, V *leverage) {
    const int falls = lever->prior > R(0.0);
    const real *column[HK_GROUP];
    V sum;
    int at = 0;
#if HK_LANES > 1
    if (falls && lever->full && lever->k >= HK_FIRST_COLUMNS) {
        sum = hkv_first_products(lever, phi, white) * lever->prior + lever->offset;
        for (; at < HK_FIRST_COLUMNS; at++) sum = sum - white[at] * white[at];
        *leverage = sum;
        if (!HK(any)(NOT(sum <= SPLAT(enough)))) return 0;
    } else
#endif
        *leverage = sum = HK(centered)(lever, phi) * lever->prior + lever->offset;
    for (; at < lever->k; at += HK_GROUP) {
        const int rows = HK(columns)(lever, at, column);
        HK(products)(rows, column, phi, white + at);
        for (int l = 0; l < HK_GROUP; l++) {
            if (at + l >= lever->k) white[at + l] = SPLAT(0.0);
            const V square = white[at + l] * white[at + l];
            sum = falls ? sum - square : sum + square;
        }
        *leverage = sum;
        if (falls && !HK(any)(NOT(sum <= SPLAT(enough)))) return 0;
    }
    /* `leverage_slope` reads whole groups. */
    for (at = lever->k; at % HK_GROUP; at++) white[at] = SPLAT(0.0);
    return 1;
}

/* Its slope (f) by the features, 2 R r or 2 prior v - 2 R r; in place of v. */
static inline void HK(leverage_slope)(const hk_factor *lever, const V *white, V *v) {
    const int falls = lever->prior > R(0.0);
    const real *column[HK_GROUP];
    for (int i = 0; i < lever->f; i++) v[i] = v[i] * (R(2.0) * lever->prior);
    for (int at = 0; at < lever->k; at += HK_GROUP) {
        const int rows = HK(columns)(lever, at, column);
        V r[HK_GROUP];
        for (int l = 0; l < HK_GROUP; l++) r[l] = white[at + l] * (falls ? R(-2.0) : R(2.0));
        for (int i = 0; i < rows; i++) {
            V sum = v[i];
            for (int l = 0; l < HK_GROUP; l++) sum = sum + r[l] * column[l][i];
            v[i] = sum;
        }
    }
}

/* The leverage of q by the features of a network, or by [1, u, u^2]; an upper bound if that is at
   most `enough`. */
static inline V HK(leverage_at)(const hk_plan *p, int at, real enough, const V *q, HK(seen) * seen,
                                V *work) {
    const int n = p->code[at + HK_N];
    const hk_factor lever = HK(lever)(p, at);
    if (seen->white_of == at) return seen->leverage;
    if (seen->phi_of != at && HK_IS(p, at, HK_ELM)) {
        V *x = HK(take)(&work, p->code[at + HK_M]);
        HK(regress)(p, at, q, x, NULL, seen->phi, work);
    } else if (seen->phi_of != at) {
        seen->phi[0] = SPLAT(1.0);
        HK(scaled)(n, hk_numbers(p, at), q, seen->phi + 1);
        for (int j = 1; j <= n; j++) seen->phi[n + j] = seen->phi[j] * seen->phi[j];
    }
    const int exact = HK(leverage)(&lever, enough, seen->phi, seen->white, &seen->leverage);
    seen->white_of = exact ? at : -1;
    seen->phi_of = -1;
    return seen->leverage;
}

/* Its slope (n) by q, after `leverage_at`. */
static inline void HK(leverage_slope_at)(const hk_plan *p, int at, const V *q, HK(seen) * seen,
                                         V *slope, V *work) {
    const int32_t *node = p->code + at;
    const int n = node[HK_N], m = node[HK_M];
    const real *center = hk_numbers(p, at), *w = center + 2 * n + m + m * n;
    V *u = HK(take)(&work, n), *back = seen->phi;
    const hk_factor lever = HK(lever)(p, at);
    HK(leverage_slope)(&lever, seen->white, back);
    HK(scaled)(n, center, q, u);
    if (HK_IS(p, at, HK_ELM)) {
        const int n_hidden = node[HK_MORE];
        for (int j = 0; j < n; j++) slope[j] = lever.f > n_hidden ? back[n_hidden + j] : SPLAT(0.0);
        for (int h = 0; h < n_hidden; h++) {
            const real *unit = w + h / HK_GROUP * HK_GROUP * (n + 1 + m) + h % HK_GROUP;
            V a = SPLAT(unit[HK_GROUP * n]), d;
            for (int j = 0; j < n; j++) a = a + u[j] * unit[HK_GROUP * j];
            HK(activate)(node[HK_MORE + 1], 1, &a, &d);
            d = d * back[h];
            for (int j = 0; j < n; j++) slope[j] = slope[j] + d * unit[HK_GROUP * j];
        }
    } else
        for (int j = 0; j < n; j++) slope[j] = back[1 + j] + R(2.0) * u[j] * back[n + 1 + j];
    for (int j = 0; j < n; j++) slope[j] = slope[j] * center[n + j];
}

/* How far q is from the training rows of a guard, at most 1 among them; an upper bound if that is
   at most `enough`. */
static inline V HK(guard_distance)(const hk_plan *p, int at, real enough, const V *q,
                                   HK(seen) * seen, V *work) {
    const real farthest = hk_numbers(p, at)[1];
    return HK(leverage_at)(p, p->code[at + HK_MORE], enough * farthest, q, seen, work) / farthest;
}

/* Its slope (n), after `guard_distance`. */
static inline void HK(guard_slope)(const hk_plan *p, int at, const V *q, HK(seen) * seen, V *slope,
                                   V *work) {
    const real farthest = hk_numbers(p, at)[1];
    HK(leverage_slope_at)(p, p->code[at + HK_MORE], q, seen, slope, work);
    for (int j = 0; j < p->code[at + HK_N]; j++) slope[j] = slope[j] / farthest;
}

/* The weight g = 1 / (1 + excess^3) of a guard, and its slope (n) where not NULL. The excess begins
   at the distance HK_FULL. Returns whether any row fades; else g is 1 and the slope is not written, and the distance may be an upper bound if not `exact`, see hk_plan. */
static inline int HK(fading)(const hk_plan *p, int at, int exact, const V *q, HK(seen) * seen,
                             V *distance, V *g, V *slope, V *work) {
    const real full = HK_FULL;
    const real enough = exact ? p->enough : full * (R(1.0) - R(8.0) * HK_EPS);
    *g = SPLAT(1.0);
    *distance = HK(guard_distance)(p, at, enough, q, seen, work);
    if (!HK(any)(NOT(*distance <= SPLAT(full)))) return 0;
    const V excess = HK(max)(*distance / full - R(1.0), SPLAT(0.0));
    *g = R(1.0) / (R(1.0) + excess * excess * excess);
    if (!slope) return 1;
    const V along = -(*g * *g) * (R(3.0) * excess * excess) / full;
    HK(guard_slope)(p, at, q, seen, slope, work);
    for (int j = 0; j < p->code[at + HK_N]; j++) slope[j] = slope[j] * along;
    return 1;
}

/* How a correction that is too long is shortened: across its direction by `factor`, along it by
   `factor + bend`. */
typedef struct {
    V factor, bend, *along; /* (m) */
} HK(shortening);

/* Whether any correction x (m) is longer than the longest of the training rows, and then how it is
   shortened, to less than HK_LONGEST times that. */
static inline int HK(is_long)(const hk_plan *p, int at, int m, const V *x, HK(shortening) * how) {
    const real least = HK_MATH(sqrt)(HK_MATH(sqrt)(HK_TINY)), largest = hk_numbers(p, at)[0];
    const real unit = largest > least ? largest : least;
    V squares = SPLAT(0.0);
    how->factor = SPLAT(1.0);
    how->bend = SPLAT(0.0);
    for (int i = 0; i < m; i++) how->along[i] = SPLAT(0.0);
    for (int i = 0; i < m; i++) squares = squares + (x[i] / unit) * (x[i] / unit);
    if (!HK(any)(squares > SPLAT(1.0))) return 0;
    const V relative = HK(sqrt)(HK(max)(squares, SPLAT(1.0)));
    const real margin = HK_LONGEST - R(1.0);
    const V bent = HK(tanh)((relative - R(1.0)) / margin), kept = R(1.0) + margin * bent;
    how->factor = kept / relative;
    how->bend = R(1.0) - bent * bent - how->factor;
    how->bend = SELECT(squares > SPLAT(1.0), how->bend, SPLAT(0.0));
    for (int i = 0; i < m; i++) how->along[i] = x[i] / unit / relative;
    return 1;
}

/* The derivative J (m, k) of a correction after its shortening. */
static inline void HK(shorten)(const HK(shortening) * how, int m, int k, V *J) {
    for (int j = 0; j < k; j++) {
        V along = SPLAT(0.0);
        for (int i = 0; i < m; i++) along = along + how->along[i] * J[k * i + j];
        along = along * how->bend;
        for (int i = 0; i < m; i++)
            J[k * i + j] = J[k * i + j] * how->factor + along * how->along[i];
    }
}

/* The squared distance of q from the nearest of the rows that stand for the training rows, and its
   slope (n) where not NULL. After the center (n) and the axes (k, n) these rows stand in groups of
   HK_GROUP columns (k). */
static inline V HK(group_distance)(const hk_plan *p, int at, const V *q, V *slope, V *work) {
    const int n = p->code[at + HK_N], count = p->code[at + HK_MORE], k = p->code[at + HK_MORE + 1];
    const real *center = hk_numbers(p, at), *axes = center + n, *rows = axes + k * n;
    V *y = HK(take)(&work, k), *to = HK(take)(&work, k), nearest = SPLAT(0.0);
    for (int i = 0; i < k; i++) {
        y[i] = to[i] = SPLAT(0.0);
        for (int j = 0; j < n; j++) y[i] = y[i] + axes[n * i + j] * (q[j] - center[j]);
    }
    for (int g = 0; g < count; g++, rows += HK_GROUP * k) {
        V s[HK_GROUP];
        for (int l = 0; l < HK_GROUP; l++) s[l] = SPLAT(0.0);
        for (int i = 0; i < k; i++)
            for (int l = 0; l < HK_GROUP; l++) {
                const V d = y[i] - rows[HK_GROUP * i + l];
                s[l] = s[l] + d * d;
            }
        for (int l = 0; l < HK_GROUP; l++) {
            const M closer =
                g + l ? s[l] < nearest : NOT(s[l] < SPLAT(0.0)); /* the first, or NaN */
            nearest = SELECT(closer, s[l], nearest);
            for (int i = 0; slope && i < k; i++)
                to[i] = SELECT(closer, y[i] - rows[HK_GROUP * i + l], to[i]);
        }
    }
    for (int j = 0; slope && j < n; j++) {
        slope[j] = SPLAT(0.0);
        for (int i = 0; i < k; i++) slope[j] = slope[j] + R(2.0) * axes[n * i + j] * to[i];
    }
    return nearest;
}

/* What the functions of guards take at most besides `seen`. */
#define HK_GUARD_WORK(n, S, m)                                                                     \
    (HK_USES(HK_GROUP_DISTANCE) * 2 * (n) + (m) + HK_REGRESS_WORK(n, S))
