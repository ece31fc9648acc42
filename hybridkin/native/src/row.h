/* The type V that the kernels compute in, for one row.

   M is the result of a comparison. A name HK(f) stands for f of this V. */

#define HK_LANES 1
#define HK_TILE 1
#define HK_AT_ONCE HK_GROUP
#define V real
#define M int
#define HK(f) hk_##f
#define SPLAT(c) ((real)(c))
#define NOT(m) (!(m))
#define SELECT(m, a, b) ((m) ? (a) : (b))

static inline int hk_any(int m) { return m; }
static inline real hk_sqrt(real x) { return HK_MATH(sqrt)(x); }
static inline real hk_exp(real x) { return HK_MATH(exp)(x); }
static inline real hk_logistic(real x) { return R(1.0) / (R(1.0) + hk_exp(-x)); }
static inline real hk_tanh(real x) { return HK_MATH(tanh)(x); }
HK_INLINE void hk_exps(int count, real *x) {
    for (int i = 0; i < count; i++) x[i] = hk_exp(x[i]);
}
HK_INLINE void hk_logistics(int count, real *x) {
    for (int i = 0; i < count; i++) x[i] = hk_logistic(x[i]);
}
HK_INLINE void hk_tanhs(int count, real *x) {
    for (int i = 0; i < count; i++) x[i] = hk_tanh(x[i]);
}
static inline real hk_max(real a, real b) { return b > a ? b : a; }
static inline real hk_min(real a, real b) { return b < a ? b : a; }
static inline void hk_sincos(real x, real *s, real *c) {
    *s = HK_MATH(sin)(x);
    *c = HK_MATH(cos)(x);
}
