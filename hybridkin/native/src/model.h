/* Any model of a plan: value, Jacobian and domain distance of one row, or of HK_LANES rows
   (after row.h, or lanes.h). */

#include "linear.h"
#include "arcs.h"
#include "elastic.h"
#include "rigid.h"
#include "chains.h"
#include "pose.h"
#include "regressors.h"
#include "guards.h"
#include "hybrid.h"

#define HK_MODEL_WORK(n, S, m, features, powers)                                                   \
    ((n) + HK_CHAIN_WORK(n, S) + HK_REGRESS_WORK(n, S, powers) +                                   \
     HK_HYBRID_WORK(n, S, m, features, powers))

/* q + shift (n), where the actuator zeros have shifted, and the place of the model within. */
static inline int HK(before)(const hk_plan *p, int at, const V *q, V *then) {
    const real *shift = hk_numbers(p, at);
    for (int j = 0; j < p->code[at + HK_N]; j++) then[j] = q[j] + shift[j];
    return p->code[at + HK_MORE];
}

/* Vectors a (3, n), turned by R. */
static inline void HK(turn)(int n, const real *R, V *a) {
    for (int j = 0; j < n; j++) {
        const V v[3] = {a[j], a[n + j], a[2 * n + j]};
        for (int i = 0; i < 3; i++)
            a[n * i + j] = v[0] * R[3 * i] + v[1] * R[3 * i + 1] + v[2] * R[3 * i + 2];
    }
}

/* x (m) of q (n); the Jacobian J (m, n) and the domain distance where not NULL. x is R f(q + shift)
   + p, where base and actuator zeros have changed. */
static inline void HK(model)(const hk_plan *p, int at, const V *q, V *x, V *J, V *distance,
                             V *work) {
    const int n = p->code[at + HK_N], m = p->code[at + HK_M];
    const real *R = NULL;
    V *then = HK(take)(&work, n);
    if (HK_IS(p, at, HK_SHIFTED)) {
        at = HK(before)(p, at, q, then);
        q = then;
    }
    if (HK_IS(p, at, HK_MOVED)) {
        R = hk_numbers(p, at);
        at = p->code[at + HK_MORE];
    }
    if (distance) *distance = SPLAT(0.0);
    if (HK_IS(p, at, HK_HYBRID))
        HK(hybrid)(p, at, q, x, J, distance, work);
    else if (HK_IS(p, at, HK_ARCS) || HK_IS(p, at, HK_ELASTIC) || HK_IS(p, at, HK_RIGID))
        HK(chain)(p, at, q, x, J, work);
    else
        HK(regress)(p, at, q, x, J, NULL, work);
    if (!R) return;
    for (int k = 0; k < m; k += 3) {
        HK(turn)(1, R, x + k);
        for (int i = 0; i < 3; i++) x[k + i] = x[k + i] + R[9 + i];
        if (J) HK(turn)(n, R, J + n * k);
    }
}

/* The largest distance of any guard, and its slope (n) by q where not NULL. */
static inline void HK(domain)(const hk_plan *p, int at, const V *q, V *distance, V *slope,
                              V *work) {
    V *then = HK(take)(&work, p->code[at + HK_N]);
    if (HK_IS(p, at, HK_SHIFTED)) {
        at = HK(before)(p, at, q, then);
        q = then;
    }
    if (HK_IS(p, at, HK_MOVED)) at = p->code[at + HK_MORE];
    HK(farthest)(p, at, q, distance, slope, work);
}
