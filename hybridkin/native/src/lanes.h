/* The type V that the kernels compute in, for HK_LANES rows side by side: instead of row.h. */

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
    hk_bits any = 0;
    EACH(i) any |= m[i];
    return any != 0;
}

static inline V hkv_sqrt(V x) {
    V r;
    EACH(i) r[i] = HK_MATH(sqrt)(x[i]);
    return r;
}

static inline V hkv_max(V a, V b) { /* the NaN of an a stays; one instruction where so written */
    EACH(i) a[i] = a[i] < b[i] ? b[i] : a[i];
    return a;
}

static inline V hkv_min(V a, V b) {
    EACH(i) a[i] = b[i] < a[i] ? b[i] : a[i];
    return a;
}

/* exp by x = k ln 2 + r and a minimax polynomial in r, right to 3e-16 up to ln 2 / 2. The product
   with 2^k keeps every NaN; a sum of bits would not. */
static inline V hkv_exp(V x) {
    const V round = SPLAT(6755399441056767.0); /* 1.5 * 2^52 + 1023: the sum's last bits are those
                                                  of the exponent of 2^k */
    x = hkv_min(hkv_max(x, SPLAT(-708.0)), SPLAT(709.0));
    const V shifted = x * 1.4426950408889634 + round, k = shifted - round;
    const V r = (x - k * 6.93147180369123816490e-1) - k * 1.90821492927058770002e-10;
    V y = SPLAT(2.7476727591429536815e-7);
    y = y * r + 2.7635013162445406779e-6;
    y = y * r + 2.4801932040583279556e-5;
    y = y * r + 1.9841185184666530655e-4;
    y = y * r + 1.3888888515778345185e-3;
    y = y * r + 8.3333333709071248824e-3;
    y = y * r + 4.166666666813876456e-2;
    y = y * r + 1.6666666666611474018e-1;
    y = y * r + 4.9999999999998320886e-1;
    y = y * r + 1.0;
    y = y * r + 1.0;
    return y * (V)((M)shifted << 52);
}

static inline V hkv_logistic(V x) {
    const V e = hkv_exp(x);
    return e / (1.0 + e);
}

static inline V hkv_tanh(V x) { return 1.0 - 2.0 / (hkv_exp(2.0 * x) + 1.0); }

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
