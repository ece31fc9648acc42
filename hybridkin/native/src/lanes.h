/* The type V that the kernels compute in, for HK_LANES rows side by side: instead of row.h. */

#if defined(__AVX__)
#include <immintrin.h>
#endif

#undef HK_LANES
#undef V
#undef M
#undef HK
#undef SPLAT
#undef NOT
#undef SELECT

#if defined(__AVX512F__)
#define HK_LANES 8
#elif defined(__AVX__)
#define HK_LANES 4
#else
#define HK_LANES 2
#endif

/* Rows of a slope whose sums, and what they take, stand in registers together. */
#undef HK_TILE
#undef HK_AT_ONCE
#if defined(__AVX512F__) || defined(__aarch64__)
#define HK_TILE 3
#else
#define HK_TILE 1
#endif
#define HK_AT_ONCE 128      /* hidden units */
#define HK_FIRST_COLUMNS 12 /* columns of a leverage after which it is first looked at */

typedef real hk_lanes __attribute__((vector_size(HK_LANES * sizeof(real))));
typedef hk_bits hk_mask __attribute__((vector_size(HK_LANES * sizeof(real))));
#define V hk_lanes
#define M hk_mask
#define HK(f) hkv_##f
#define SPLAT(c) ((V){0} + (real)(c))
#define NOT(m) (~(m))
#define SELECT(m, a, b) ((V)(((M)(a) & (m)) | ((M)(b) & ~(m))))
#define EACH(i) for (int i = 0; i < HK_LANES; i++)

/* The first place for lanes in memory. */
static inline V *hkv_aligned(real *work) {
    const uintptr_t at = (uintptr_t)work + sizeof(V) - 1;
    return (V *)(at - at % sizeof(V));
}

static inline int hkv_any(M m) {
#if defined(__AVX512F__)
    return _mm512_test_epi64_mask((__m512i)m, (__m512i)m) != 0;
#elif defined(__AVX__)
    return _mm256_movemask_pd((__m256d)m) != 0;
#else
    hk_bits any = 0;
    EACH(i) any |= m[i];
    return any != 0;
#endif
}

static inline V hkv_sqrt(V x) {
    V r;
    EACH(i) r[i] = HK_MATH(sqrt)(x[i]);
    return r;
}

#if defined(__AVX512F__)
#define HK_LARGER(a, b) (V) _mm512_max_pd((__m512d)(b), (__m512d)(a))
#define HK_SMALLER(a, b) (V) _mm512_min_pd((__m512d)(b), (__m512d)(a))
#elif defined(__AVX__)
#define HK_LARGER(a, b) (V) _mm256_max_pd((__m256d)(b), (__m256d)(a))
#define HK_SMALLER(a, b) (V) _mm256_min_pd((__m256d)(b), (__m256d)(a))
#else
#define HK_LARGER(a, b) SELECT((a) < (b), b, a)
#define HK_SMALLER(a, b) SELECT((b) < (a), b, a)
#endif

static inline V hkv_max(V a, V b) { return HK_LARGER(a, b); } /* the NaN of an a stays */
static inline V hkv_min(V a, V b) { return HK_SMALLER(a, b); }

/* A matrix of HK_LANES columns, transposed in its place. */
static inline void hkv_transpose(V *a) {
#if defined(__AVX512F__)
    V pair[8], four[8];
    for (int i = 0; i < 8; i += 2) {
        pair[i] = (V)_mm512_unpacklo_pd((__m512d)a[i], (__m512d)a[i + 1]);
        pair[i + 1] = (V)_mm512_unpackhi_pd((__m512d)a[i], (__m512d)a[i + 1]);
    }
    for (int i = 0; i < 8; i += 4)
        for (int k = i; k < i + 2; k++) {
            four[k] = (V)_mm512_shuffle_f64x2((__m512d)pair[k], (__m512d)pair[k + 2], 0x88);
            four[k + 2] = (V)_mm512_shuffle_f64x2((__m512d)pair[k], (__m512d)pair[k + 2], 0xdd);
        }
    for (int k = 0; k < 4; k++) {
        a[k] = (V)_mm512_shuffle_f64x2((__m512d)four[k], (__m512d)four[k + 4], 0x88);
        a[k + 4] = (V)_mm512_shuffle_f64x2((__m512d)four[k], (__m512d)four[k + 4], 0xdd);
    }
#elif defined(__AVX__)
    V pair[4];
    for (int i = 0; i < 4; i += 2) {
        pair[i] = (V)_mm256_unpacklo_pd((__m256d)a[i], (__m256d)a[i + 1]);
        pair[i + 1] = (V)_mm256_unpackhi_pd((__m256d)a[i], (__m256d)a[i + 1]);
    }
    for (int k = 0; k < 2; k++) {
        a[k] = (V)_mm256_permute2f128_pd((__m256d)pair[k], (__m256d)pair[k + 2], 0x20);
        a[k + 2] = (V)_mm256_permute2f128_pd((__m256d)pair[k], (__m256d)pair[k + 2], 0x31);
    }
#else
    for (int i = 0; i < HK_LANES; i++)
        for (int j = 0; j < i; j++) {
            const real swapped = a[i][j];
            a[i][j] = a[j][i];
            a[j][i] = swapped;
        }
#endif
}

static inline V hkv_load(const real *a) {
    V v;
    __builtin_memcpy(&v, a, sizeof v);
    return v;
}

/* Lanes (width) of at most HK_LANES rows (count, width); the last row fills them up. */
static inline void hkv_from_rows(int width, int count, const real *rows, V *lanes) {
    V part[HK_LANES];
    int at = 0;
    for (; count == HK_LANES && at + HK_LANES <= width; at += HK_LANES) {
        EACH(i) part[i] = hkv_load(rows + width * i + at);
        hkv_transpose(part);
        EACH(i) lanes[at + i] = part[i];
    }
    for (; at < width; at++) {
        V column;
        if (count == HK_LANES)
            EACH(i) column[i] = rows[width * i + at];
        else
            EACH(i) column[i] = rows[width * (i < count ? i : count - 1) + at];
        lanes[at] = column;
    }
}

/* Rows (count, width) of lanes (width). Where the width is no multiple of HK_LANES, the last
   columns are written together with some before them. */
static inline void hkv_to_rows(int width, int count, const V *lanes, real *rows) {
    V part[HK_LANES];
    int at = 0;
    while (count == HK_LANES && width - at >= HK_LANES) {
        EACH(i) part[i] = lanes[at + i];
        hkv_transpose(part);
        EACH(i) __builtin_memcpy(rows + width * i + at, part + i, sizeof(V));
        at += HK_LANES;
        if (at < width && at + HK_LANES > width) at = width - HK_LANES;
    }
    for (; at < width; at++)
        for (int i = 0; i < count; i++) rows[width * i + at] = lanes[at][i];
}

/* exp(x) = y 2^k by x = k ln 2 + r and a minimax polynomial y in r, right to 3e-16 up to ln 2 / 2.
   The product with 2^k keeps every NaN; a sum of bits would not. Step by step for `count` x, at
   most HK_GROUP, which become y: one alone would wait for each of its steps. */
HK_INLINE void hkv_powers(int count, V *x, V *scale) {
    static const real factors[] = {2.7635013162445406779e-6,
                                   2.4801932040583279556e-5,
                                   1.9841184185666530655e-4,
                                   1.3888888515778345185e-3,
                                   8.3333333709071248824e-3,
                                   4.166666666813876456e-2,
                                   1.6666666666611474018e-1,
                                   4.9999999999998320886e-1,
                                   1.0,
                                   1.0};
    const V round = SPLAT(6755399441056767.0); /* 1.5 * 2^52 + 1023: the sum's last bits are those
                                                  of the exponent of 2^k */
    V r[HK_GROUP];
    for (int i = 0; i < count; i++) {
        const V within = hkv_min(hkv_max(x[i], SPLAT(-708.0)), SPLAT(709.0));
        const V shifted = within * 1.4426950408889634 + round, k = shifted - round;
        r[i] = (within - k * 6.93147180369123816490e-1) - k * 1.90821492927058770002e-10;
        scale[i] = (V)((M)shifted << 52);
        x[i] = SPLAT(2.7476727591429536815e-7);
    }
    for (int step = 0; step < 10; step++)
        for (int i = 0; i < count; i++) x[i] = x[i] * r[i] + factors[step];
}

HK_INLINE void hkv_exps(int count, V *x) {
    V scale[HK_GROUP];
    hkv_powers(count, x, scale);
    for (int i = 0; i < count; i++) x[i] = x[i] * scale[i];
}

static inline V hkv_exp(V x) {
    hkv_exps(1, &x);
    return x;
}

HK_INLINE void hkv_logistics(int count, V *x) {
    V scale[HK_GROUP];
    for (int i = 0; i < count; i++) x[i] = -x[i];
    hkv_powers(count, x, scale);
    for (int i = 0; i < count; i++) x[i] = 1.0 / (x[i] * scale[i] + 1.0);
}

HK_INLINE void hkv_tanhs(int count, V *x) {
    for (int i = 0; i < count; i++) x[i] = 2.0 * x[i];
    hkv_exps(count, x);
    for (int i = 0; i < count; i++) x[i] = 1.0 - 2.0 / (x[i] + 1.0);
}

static inline V hkv_tanh(V x) {
    hkv_tanhs(1, &x);
    return x;
}

/* sin and cos by x = k pi / 2 + r and Taylor's series in r, up to pi / 4; huge x one by one. */
static inline void hkv_sincos(V x, V *s, V *c) {
    const V round = SPLAT(6755399441055744.0);
    const V shifted = x * 6.36619772367581382433e-01 + round, k = shifted - round;
    const V r = ((x - k * 1.57079632673412561417e+00) - k * 6.07710050630396597660e-11) -
                k * 2.02226624879595063154e-21;
    const V z = r * r;
    V a = SPLAT(1.58969099521155010221e-10), b = SPLAT(-1.13596475577881948265e-11);
    a = a * z - 2.50507602534068634195e-08;
    b = b * z + 2.08757232129817482790e-09;
    a = a * z + 2.75573137070700676789e-06;
    b = b * z - 2.75573143513906633035e-07;
    a = a * z - 1.98412698298579493134e-04;
    b = b * z + 2.48015872894767294178e-05;
    a = a * z + 8.33333333332248946124e-03;
    b = b * z - 1.38888888888741095749e-03;
    a = a * z - 1.66666666666666324348e-01;
    b = b * z + 4.16666666666666019037e-02;
    const V sine = r + r * z * a, cosine = (1.0 - 0.5 * z) + z * z * b;
    const M quadrant = (M)shifted, odd = (quadrant & 1) != 0;
    const M sign_s = (quadrant & 2) << 62, sign_c = ((quadrant + 1) & 2) << 62;
    *s = (V)((M)SELECT(odd, cosine, sine) ^ sign_s);
    *c = (V)((M)SELECT(odd, sine, cosine) ^ sign_c);
    const M huge = (x > SPLAT(1e5)) | (x < SPLAT(-1e5));
    if (hkv_any(huge))
        EACH(i)
            if (huge[i]) {
                (*s)[i] = sin(x[i]);
                (*c)[i] = cos(x[i]);
            }
}
