/* Mechanical models, taken apart: q -> inner coordinates z -> tip x. Serial coupling acts on z. */

/* What `pull` needs to know of a row besides z. */
typedef struct {
    int nothing;
} HK(inside);


static inline int HK(n_coordinates)(const hk_plan *p, int at) {
    return p->code[at] == HK_ARCS ? 3 * p->code[at + HK_MORE] : p->code[at + HK_N];
}

/* The inner coordinates z of q, and what `pull` needs. */
static inline void HK(coordinates)(const hk_plan *p, int at, const V *q, V *z, HK(inside) *in) {
    const int32_t *node = p->code + at;
    const int n = node[HK_N], k = 3 * node[HK_MORE];
    const real *numbers = hk_numbers(p, at);
    (void)in;
    if (n == 9 && k == 9)
        HK(affine)(9, 9, numbers, numbers + 81, q, z);
    else
        HK(affine)(k, n, numbers, numbers + k * n, q, z);
}

/* The tip x (3) of inner coordinates z, and its derivative C (3, k) where not NULL. */
static inline void HK(from_coordinates)(const hk_plan *p, int at, const V *z, V *x, V *C) {
    const int32_t *node = p->code + at;
    const int n = node[HK_N], k = 3 * node[HK_MORE];
    HK(arcs_tip)(node[HK_MORE], hk_numbers(p, at) + k * n + k, z, x, C);
}

/* J (3, n) += C dz/dq, for C (3, k). */
static inline void HK(pull)(const hk_plan *p, int at, const HK(inside) *in, const V *C, V *J) {
    const int32_t *node = p->code + at;
    const int n = node[HK_N], k = 3 * node[HK_MORE];
    (void)in;
    if (n == 9 && k == 9)
        HK(fold)(9, 9, C, hk_numbers(p, at), J);
    else
        HK(fold)(k, n, C, hk_numbers(p, at), J);
}

static inline void HK(chain)(const hk_plan *p, int at, const V *q, V *x, V *J) {
    V z[HK_MAX_Z], C[3 * HK_MAX_Z];
    HK(inside) in;
    HK(coordinates)(p, at, q, z, &in);
    HK(from_coordinates)(p, at, z, x, J ? C : NULL);
    if (!J) return;
    for (int i = 0; i < 3 * p->code[at + HK_N]; i++) J[i] = SPLAT(0.0);
    HK(pull)(p, at, &in, C, J);
}
