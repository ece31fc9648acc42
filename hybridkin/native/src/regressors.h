/* Learned models q (n) -> x (m) with their Jacobians J (m, n). */

/* sigma(a) of `count` hidden units in place of a, and sigma'(a) in d. */
HK_INLINE void HK(activate)(int activation, int count, V *a, V *d) {
    switch (activation) {
    case HK_LOGISTIC:
        HK(logistics)(count, a);
        for (int i = 0; i < count; i++) d[i] = a[i] - a[i] * a[i];
        break;
    case HK_TANH:
        HK(tanhs)(count, a);
        for (int i = 0; i < count; i++) d[i] = R(1.0) - a[i] * a[i];
        break;
    case HK_SIN:
        for (int i = 0; i < count; i++) {
            V sine;
            HK(sincos)(a[i], &sine, &d[i]);
            a[i] = sine;
        }
        break;
    default: /* a Gaussian, of minus half the squared distance */
        for (int i = 0; i < count; i++) a[i] = HK(min)(a[i], SPLAT(0.0));
        HK(exps)(count, a);
        for (int i = 0; i < count; i++) d[i] = a[i];
    }
}

/* The next `count` units: their sigma' in d, and their share in x (m). `features` as for
   `units_of`. The weights of HK_GROUP units stand together: W transposed (n, HK_GROUP), b
   (HK_GROUP), output weights (m, HK_GROUP); units that fill up the last group have none. */
HK_INLINE void HK(next_units)(int n, int m, int count, int activation, const real *w, const V *u,
                              V shift, V *x, V *d, V *features) {
    const real *bias = w + HK_GROUP * n, *out = bias + HK_GROUP;
    V s[HK_GROUP];
    for (int i = 0; i < count; i++) s[i] = shift + bias[i];
    HK_UNROLLED
    for (int j = 0; j < n; j++)
        for (int i = 0; i < count; i++) s[i] = s[i] + u[j] * w[HK_GROUP * j + i];
    HK(activate)(activation, count, s, d);
    for (int o = 0; o < m; o++, out += HK_GROUP) {
        V sum = s[0] * out[0]; /* which need not wait for the units before */
        for (int i = 1; i < count; i++) sum = sum + s[i] * out[i];
        x[o] = x[o] + sum;
    }
    for (int i = 0; features && i < count; i++) features[i] = s[i];
}

/* Adds what `count` units contribute to a part of their slope J (m, n): the rows o to o + rows, of
   these the columns j to j + columns, which fit into registers. d (count) holds sigma'. */
HK_INLINE void HK(slope_part)(int n, int m, int count, const real *w, const V *d, int o, int rows,
                              int j, int columns, V *J) {
    V sum[HK_TILE][HK_MAX_N], t[HK_TILE];
    J += n * o + j;
    for (int r = 0; r < rows; r++)
        for (int c = 0; c < columns; c++) sum[r][c] = J[n * r + c];
    for (; count > 0; count -= HK_GROUP, d += HK_GROUP, w += HK_GROUP * (n + 1 + m)) {
        const real *in = w + HK_GROUP * j, *out = w + HK_GROUP * (n + 1 + o);
        for (int i = 0; i < HK_GROUP && i < count; i++) {
            for (int r = 0; r < rows; r++) t[r] = d[i] * out[HK_GROUP * r + i];
            for (int c = 0; c < columns; c++)
                for (int r = 0; r < rows; r++) sum[r][c] = sum[r][c] + t[r] * in[HK_GROUP * c + i];
        }
    }
    for (int r = 0; r < rows; r++)
        for (int c = 0; c < columns; c++) J[n * r + c] = sum[r][c];
}

/* The same for all columns of these rows. */
HK_INLINE void HK(slope_rows)(int n, int m, int count, const real *w, const V *d, int o, int rows,
                              V *J) {
    int j = 0;
    if (HK_COMMON(1)) {
        for (; j + 9 <= n; j += 9) HK(slope_part)(n, m, count, w, d, o, rows, j, 9, J);
        for (; j + 6 <= n; j += 6) HK(slope_part)(n, m, count, w, d, o, rows, j, 6, J);
        for (; j + 3 <= n; j += 3) HK(slope_part)(n, m, count, w, d, o, rows, j, 3, J);
    }
    if (j < n) HK(slope_part)(n, m, count, w, d, o, rows, j, n - j, J);
}

/* Adds the share of all hidden units in x (m) and in its slope J (m, n) by u (n), where not NULL,
   and writes their sigma into `features`, where not NULL: whole groups, or halves of them. */
HK_INLINE void HK(units_of)(int n, int m, int units, int activation, const real *w, const V *u,
                            V shift, V *x, V *J, V *features) {
    const int stride = HK_GROUP * (n + 1 + m);
    V d[HK_AT_ONCE];
    while (units > 0) {
        const real *first = w;
        int count = 0;
        for (; units > 0 && count < HK_AT_ONCE; units -= HK_GROUP, w += stride) {
            const int half = units <= HK_GROUP / 2;
            if (half)
                HK(next_units)(n, m, HK_GROUP / 2, activation, w, u, shift, x, d + count, features);
            else
                HK(next_units)(n, m, HK_GROUP, activation, w, u, shift, x, d + count, features);
            count += half ? HK_GROUP / 2 : HK_GROUP;
            if (features) features += HK_GROUP;
        }
        int o = 0;
        for (; J && o + HK_TILE <= m; o += HK_TILE)
            HK(slope_rows)(n, m, count, first, d, o, HK_TILE, J);
        for (; J && o < m; o++) HK(slope_rows)(n, m, count, first, d, o, 1, J);
    }
}

#if HK_LANES == 1 && defined(HK_ROW_LANES)
/* One row with lanes over the hidden units, below; it stands in the library alone. */
static void hkr_units(int n, int m, int units, int activation, const real *w, const real *u,
                      real shift, real *x, real *J, real *features, real *work);
#endif
#if HK_LANES > 1
static inline real HK(sum)(V v) {
    for (int half = HK_LANES / 2; half > 0; half /= 2)
        for (int i = 0; i < half; i++) v[i] += v[i + half];
    return v[0];
}

#define HK_BLOCK 64 /* units whose weights stay in the first cache */

HK_INLINE void hkr_units_of(int n, int m, int units, int activation, const real *w, const real *u,
                            real shift, real *x, real *J, real *features, real *work) {
    const int each = HK_GROUP / HK_LANES, stride = HK_GROUP * (n + 1 + m);
    V s[HK_BLOCK / HK_LANES], d[HK_BLOCK / HK_LANES], *lanes = HK(aligned)(work);
    V *value = HK(take)(&lanes, m), *slope = HK(take)(&lanes, m * n);
    for (int o = 0; o < m; o++) value[o] = SPLAT(0.0);
    for (int k = 0; J && k < m * n; k++) slope[k] = SPLAT(0.0);
    for (; units > 0; units -= HK_BLOCK, w += HK_BLOCK / HK_GROUP * stride) {
        const int count = ((units < HK_BLOCK ? units : HK_BLOCK) + HK_GROUP - 1) / HK_GROUP * each;
        for (int i = 0; i < count; i++) {
            const real *of = w + i / each * stride + i % each * HK_LANES;
            s[i] = HK(load)(of + HK_GROUP * n) + shift;
            for (int j = 0; j < n; j++) s[i] = s[i] + HK(load)(of + HK_GROUP * j) * u[j];
        }
        int done = 0; /* few at a time: the lanes of `count` units fill registers */
        for (; done + 4 <= count; done += 4) HK(activate)(activation, 4, s + done, d + done);
        for (; done < count; done++) HK(activate)(activation, 1, s + done, d + done);
        for (int i = 0; features && i < count; i++, features += HK_LANES)
            __builtin_memcpy(features, s + i, sizeof(V));
        for (int o = 0; o < m; o++) {
            const real *out = w + HK_GROUP * (n + 1 + o);
            V row[HK_MAX_N];
            for (int i = 0; i < count; i++)
                value[o] =
                    value[o] + s[i] * HK(load)(out + i / each * stride + i % each * HK_LANES);
            if (!J) continue;
            for (int j = 0; j < n; j++) row[j] = slope[n * o + j];
            for (int i = 0; i < count; i++) {
                const int at = i / each * stride + i % each * HK_LANES;
                const V t = d[i] * HK(load)(out + at);
                for (int j = 0; j < n; j++) row[j] = row[j] + t * HK(load)(w + at + HK_GROUP * j);
            }
            for (int j = 0; j < n; j++) slope[n * o + j] = row[j];
        }
    }
    for (int o = 0; o < m; o++) x[o] += HK(sum)(value[o]);
    for (int k = 0; J && k < m * n; k++) J[k] += HK(sum)(slope[k]);
}

static void hkr_units(int n, int m, int units, int activation, const real *w, const real *u,
                      real shift, real *x, real *J, real *features, real *work) {
    if (units == 0) return; /* affine */
    if (n == 9 && m == 3)
        hkr_units_of(9, 3, units, activation, w, u, shift, x, J, features, work);
    else
        hkr_units_of(n, m, units, activation, w, u, shift, x, J, features, work);
}
#endif

static inline void HK(units)(int n, int m, int units, int activation, const real *w, const V *u,
                             V shift, V *x, V *J, V *features, V *work) {
#if HK_LANES == 1 && defined(HK_ROW_LANES)
    hkr_units(n, m, units, activation, w, u, shift, x, J, features, work);
#else
    (void)work;
    if (HK_COMMON(n == 9 && m == 3))
        HK(units_of)(9, 3, units, activation, w, u, shift, x, J, features);
    else
        HK(units_of)(n, m, units, activation, w, u, shift, x, J, features);
#endif
}

/* u = (q - center) / scale; the scale's inverse follows the center. Folded into later weights it
   would cancel digits. */
static inline void HK(scaled)(int n, const real *center, const V *q, V *u) {
    for (int j = 0; j < n; j++) u[j] = (q[j] - center[j]) * center[n + j];
}

/* From the sums of the units x (m) and their slopes J (m, n) by u to c + D u + x, and the slopes by
 * q. */
HK_INLINE void HK(network_end)(int n, int m, int gaussian, const real *inverse, const real *c,
                               const V *u, V *x, V *J) {
    const real *direct = c + m;
    for (int o = 0; o < m; o++, direct += n) {
        for (int j = 0; J && j < n; j++) {
            if (gaussian) J[n * o + j] = J[n * o + j] - x[o] * u[j];
            J[n * o + j] = (J[n * o + j] + direct[j]) * inverse[j];
        }
        x[o] = x[o] + c[o];
        for (int j = 0; j < n; j++) x[o] = x[o] + u[j] * direct[j];
    }
}

/* x = c + D u + V sigma(W u + b): networks with direct link, affine maps, Gaussian kernels.

   Writes the features too where asked: the hidden units', then u. A Gaussian at u_i is the unit
   exp(u_i . u - |u_i|^2 / 2 - |u|^2 / 2). */
static inline void HK(elm)(const hk_plan *p, int at, const V *q, V *x, V *J, V *features, V *work) {
    const int32_t *node = p->code + at, *more = node + HK_MORE;
    const int n = node[HK_N], m = node[HK_M], n_hidden = more[0], activation = more[1];
    const int gaussian = activation == HK_GAUSSIAN;
    const real *center = hk_numbers(p, at), *inverse = center + n;
    const real *intercept = inverse + n, *units = intercept + m + m * n;
    V *u = HK(take)(&work, n), shift = SPLAT(0.0);
    HK(scaled)(n, center, q, u);
    for (int j = 0; gaussian && j < n; j++) shift = shift - R(0.5) * u[j] * u[j];
    for (int o = 0; o < m; o++) x[o] = SPLAT(0.0);
    for (int k = 0; J && k < m * n; k++) J[k] = SPLAT(0.0);
    HK(units)(n, m, n_hidden, activation, units, u, shift, x, J, features, work);
    if (HK_COMMON(n == 9 && m == 3 && !gaussian))
        HK(network_end)(9, 3, 0, inverse, intercept, u, x, J);
    else
        HK(network_end)(n, m, gaussian, inverse, intercept, u, x, J);
    if (features)
        for (int j = 0; j < n; j++) features[n_hidden + j] = u[j];
}

/* value = c + D u + u' A u / 2 with symmetric A, output by output; its slope by u is D + A u. */
HK_INLINE void HK(quadratic_of)(int n, int m, const real *c, const real *inverse,
                                const V *restrict u, V *restrict x, V *restrict J) {
    for (int o = 0; o < m; o++, c += 1 + n + n * n) {
        V slope[HK_MAX_N], sum = SPLAT(0.0);
        for (int j = 0; j < n; j++) slope[j] = SPLAT(c[1 + j]);
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) slope[j] = slope[j] + u[i] * c[1 + n + n * i + j];
        for (int j = 0; j < n; j++) sum = sum + u[j] * (slope[j] + c[1 + j]);
        x[o] = R(0.5) * sum + c[0];
        for (int j = 0; J && j < n; j++) J[n * o + j] = slope[j] * inverse[j];
    }
}

/* A readout of quadratic features, or of the pose: linear features, then loads on the shape. */
static inline void HK(readout)(const hk_plan *p, int at, const V *q, V *x, V *J, V *work) {
    const int32_t *node = p->code + at, *more = node + HK_MORE;
    const int n = node[HK_N], m = node[HK_M];
    const real *center = hk_numbers(p, at), *inverse = center + n, *c = inverse + n;
    V *u = HK(take)(&work, n);
    HK(scaled)(n, center, q, u);
    if (more[0] == HK_QUADRATIC_FEATURES) {
        if (HK_COMMON(n == 9))
            HK(quadratic_of)(9, m, c, inverse, u, x, J);
        else
            HK(quadratic_of)(n, m, c, inverse, u, x, J);
        return;
    }
    const real *direct = c + m;
    HK(affine)(m, n, direct, c, u, x);
    for (int k = 0; J && k < m * n; k++) J[k] = SPLAT(direct[k] * inverse[k % n]);
    HK(pose_readout)(p, more[1], m, direct + m * n, q, x, J, work);
}

/* A regressor of q itself. `features` is for networks alone. */
static inline void HK(regress_all)(const hk_plan *p, int at, const V *q, V *x, V *J, V *features,
                                   V *work) {
    if (HK_IS(p, at, HK_READOUT))
        HK(readout)(p, at, q, x, J, work);
    else if (HK_USES(HK_ELM) || HK_USES(HK_AFFINE) || HK_USES(HK_KERNEL))
        HK(elm)(p, at, q, x, J, features, work);
}

#define HK_REGRESS_WORK(n, S) ((1 + HK_USES(HK_PROJECTED)) * (n) + HK_POSE_WORK(n, S))

/* Any regressor, also one of A q + b, the part of q that its training rows moved; A (n, n). */
static inline void HK(regress)(const hk_plan *p, int at, const V *q, V *x, V *J, V *features,
                               V *work) {
    if (!HK_IS(p, at, HK_PROJECTED)) {
        HK(regress_all)(p, at, q, x, J, features, work);
        return;
    }
    const int n = p->code[at + HK_N], m = p->code[at + HK_M];
    const real *A = hk_numbers(p, at);
    V *moved = HK(take)(&work, n);
    HK(affine)(n, n, A, A + n * n, q, moved);
    HK(regress_all)(p, p->code[at + HK_MORE], moved, x, J, NULL, work);
    for (int o = 0; J && o < m; o++, J += n) {
        V slope[HK_MAX_N];
        for (int j = 0; j < n; j++) slope[j] = SPLAT(0.0);
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) slope[j] = slope[j] + J[i] * A[n * i + j];
        for (int j = 0; j < n; j++) J[j] = slope[j];
    }
}
