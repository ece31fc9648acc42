/* Where a correction is trusted: leverage and box, weights, and the longest correction. */

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

/* Where R begins: offset and center are filled up, so that its blocks are aligned as their node. */
#define HK_LEVER(f) ((1 + (f) + HK_GROUP - 1) / HK_GROUP * HK_GROUP)

/* How many rows the block of R that begins at white number `at` has. */
static inline int HK(lever_rows)(int f, int full, int at) {
    return full ? f : at + HK_GROUP - (HK_GROUP - f % HK_GROUP) % HK_GROUP;
}

/* The leverage |white|^2 + offset, white = R' (phi - center). `lever` holds offset, center (f) and
   R (f, f) in blocks of HK_GROUP columns, the first filled up by zeros in front; of an upper
   triangular R only the rows down to the diagonal of a block. */
#if HK_LANES == 1 && defined(HK_ROW_LANES)
static real hkr_leverage(int f, int full, const real *lever, const real *phi, real *white);
#endif
#if HK_LANES > 1
static real hkr_leverage(int f, int full, const real *lever, const real *phi, real *white) {
    const real *block = lever + HK_LEVER(f);
    real sum = lever[0];
    for (int at = 0; at < f; at += HK_GROUP) {
        const int rows = HK(lever_rows)(f, full, at);
        for (int l = 0; l < HK_GROUP; l += HK_LANES) {
            V r = SPLAT(0.0), s = r, t = r, v = r;
            int i = 0;
            for (; i + 4 <= rows; i += 4) { /* four sums: none waits for the one before */
                r = r + HK(load)(block + HK_GROUP * i + l) * phi[i];
                s = s + HK(load)(block + HK_GROUP * (i + 1) + l) * phi[i + 1];
                t = t + HK(load)(block + HK_GROUP * (i + 2) + l) * phi[i + 2];
                v = v + HK(load)(block + HK_GROUP * (i + 3) + l) * phi[i + 3];
            }
            for (; i < rows; i++) r = r + HK(load)(block + HK_GROUP * i + l) * phi[i];
            r = (r + s) + (t + v);
            __builtin_memcpy(white + at + l, &r, sizeof r);
            sum += HK(sum)(r * r);
        }
        block += HK_GROUP * rows;
    }
    return sum;
}
#endif

static inline V HK(leverage)(int f, int full, const real *lever, V *phi, V *white) {
    for (int i = 0; i < f; i++) phi[i] = phi[i] - lever[1 + i];
#if HK_LANES == 1 && defined(HK_ROW_LANES)
    return hkr_leverage(f, full, lever, phi, white);
#else
    const real *block = lever + HK_LEVER(f);
    V sum = SPLAT(lever[0]);
    for (int at = 0; at < f; at += HK_GROUP) {
        const int rows = HK(lever_rows)(f, full, at);
        V r[HK_GROUP];
        for (int l = 0; l < HK_GROUP; l++) r[l] = SPLAT(0.0);
        for (int i = 0; i < rows; i++)
            for (int l = 0; l < HK_GROUP; l++) r[l] = r[l] + phi[i] * block[HK_GROUP * i + l];
        for (int l = 0; l < HK_GROUP; l++) sum = sum + r[l] * r[l];
        for (int l = 0; l < HK_GROUP; l++) white[at + l] = r[l];
        block += HK_GROUP * rows;
    }
    return sum;
#endif
}

/* The slope (n) of the leverage by the features, slope = 2 R white. */
static inline void HK(leverage_slope)(int f, int full, const real *lever, const V *white,
                                      V *slope) {
    const real *block = lever + HK_LEVER(f);
    for (int i = 0; i < f; i++) slope[i] = SPLAT(0.0);
    for (int at = 0; at < f; at += HK_GROUP) {
        const int rows = HK(lever_rows)(f, full, at);
        for (int i = 0; i < rows; i++) {
            V sum = white[at] * block[HK_GROUP * i];
            for (int l = 1; l < HK_GROUP; l++) sum = sum + white[at + l] * block[HK_GROUP * i + l];
            slope[i] = slope[i] + R(2.0) * sum;
        }
        block += HK_GROUP * rows;
    }
}

/* Where the numbers of a model's leverage begin, how many features it has, and whether R is full.
 */
static inline const real *HK(lever)(const hk_plan *p, int at, int *f, int *full) {
    const int32_t *node = p->code + at, *more = node + HK_MORE;
    const int n = node[HK_N], m = node[HK_M], network = HK_IS(p, at, HK_ELM);
    const int groups = network ? (more[0] + HK_GROUP - 1) / HK_GROUP : 0;
    *f = network ? more[2] : 2 * n + 1;
    *full = network && more[3];
    return hk_numbers(p, at) + 2 * n + m + m * n + groups * HK_GROUP * (n + 1 + m);
}

/* The leverage of q by the features of a network, or by [1, u, u^2]. */
static inline V HK(leverage_at)(const hk_plan *p, int at, const V *q, HK(seen) * seen, V *work) {
    const int n = p->code[at + HK_N];
    int f, full;
    const real *lever = HK(lever)(p, at, &f, &full);
    if (seen->white_of == at) return seen->leverage;
    if (seen->phi_of != at && HK_IS(p, at, HK_ELM)) {
        V *x = HK(take)(&work, p->code[at + HK_M]);
        HK(regress)(p, at, q, x, NULL, seen->phi, work);
    } else if (seen->phi_of != at) {
        seen->phi[0] = SPLAT(1.0);
        HK(scaled)(n, hk_numbers(p, at), q, seen->phi + 1);
        for (int j = 1; j <= n; j++) seen->phi[n + j] = seen->phi[j] * seen->phi[j];
    }
    seen->leverage = HK(leverage)(f, full, lever, seen->phi, seen->white);
    seen->white_of = at;
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
    int f, full;
    const real *lever = HK(lever)(p, at, &f, &full);
    HK(leverage_slope)(f, full, lever, seen->white, back);
    HK(scaled)(n, center, q, u);
    if (HK_IS(p, at, HK_ELM)) {
        const int n_hidden = node[HK_MORE];
        for (int j = 0; j < n; j++) slope[j] = f > n_hidden ? back[n_hidden + j] : SPLAT(0.0);
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

/* How far q is from the training rows of a guard, at most 1 among them. */
static inline V HK(guard_distance)(const hk_plan *p, int at, const V *q, HK(seen) * seen, V *work) {
    const int n = p->code[at + HK_N];
    const real *numbers = hk_numbers(p, at), *low = numbers + 1, *high = low + n;
    if (HK_IS(p, at, HK_LEVERAGE_GUARD))
        return HK(leverage_at)(p, p->code[at + HK_MORE], q, seen, work) / numbers[1];
    V sum = SPLAT(1.0);
    for (int j = 0; j < n; j++) {
        const V below = HK(max)(low[j] - q[j], SPLAT(0.0)),
                above = HK(max)(q[j] - high[j], SPLAT(0.0));
        const V out = (below + above) * high[n + j];
        sum = sum + HK_BOX_STEEPNESS * out * out;
    }
    return sum;
}

/* Its slope (n), after `guard_distance`. */
static inline void HK(guard_slope)(const hk_plan *p, int at, const V *q, HK(seen) * seen, V *slope,
                                   V *work) {
    const int n = p->code[at + HK_N];
    const real *numbers = hk_numbers(p, at), *low = numbers + 1, *high = low + n;
    if (HK_IS(p, at, HK_LEVERAGE_GUARD)) {
        HK(leverage_slope_at)(p, p->code[at + HK_MORE], q, seen, slope, work);
        for (int j = 0; j < n; j++) slope[j] = slope[j] / numbers[1];
        return;
    }
    for (int j = 0; j < n; j++) {
        const V below = HK(max)(low[j] - q[j], SPLAT(0.0)),
                above = HK(max)(q[j] - high[j], SPLAT(0.0));
        slope[j] = R(2.0) * HK_BOX_STEEPNESS * (above - below) * high[n + j] * high[n + j];
    }
}

/* The weight g = 1 / (1 + excess^3) of a guard, and its slope (n) where not NULL. By a leverage the
   excess begins farther out than by a box. Returns whether any row fades; else g is 1
   and the slope is not written. */
static inline int HK(fading)(const hk_plan *p, int at, const V *q, HK(seen) * seen, V *distance,
                             V *g, V *slope, V *work) {
    const real full = HK_IS(p, at, HK_LEVERAGE_GUARD) ? HK_FULL_LEVERAGE : HK_FULL;
    *g = SPLAT(1.0);
    *distance = HK(guard_distance)(p, at, q, seen, work);
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
#define HK_GUARD_WORK(n, S, m, powers)                                                             \
    (HK_USES(HK_GROUP_DISTANCE) * 2 * (n) + (m) + HK_REGRESS_WORK(n, S, powers))
