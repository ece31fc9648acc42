/* Any model of a plan: value, Jacobian and domain distance of one row, or of HK_LANES rows
   (after row.h, or lanes.h). */

#include "linear.h"
#include "arcs.h"
#include "frames.h"
#include "structural.h"
#include "elastic.h"
#include "rigid.h"
#include "chains.h"
#include "pose.h"
#include "regressors.h"
#include "guards.h"
#include "hybrid.h"

#define HK_MODEL_WORK(n, S, m, features)                                                           \
    (2 * (n) + HK_CHAIN_WORK(n, S) + HK_REGRESS_WORK(n, S) + HK_HYBRID_WORK(n, S, m, features) +   \
     (HK_USES(HK_WITH_POSE) ? 6 + 6 * (n) : 0) + HK_POSES * HK_CHAIN_POSE_WORK(n, S))

/* q + shift (n), where the actuator zeros have shifted, and the place of the model within. */
static inline int HK(before)(const hk_plan *p, int at, const V *q, V *then) {
    const real *shift = hk_numbers(p, at);
    for (int j = 0; j < p->code[at + HK_N]; j++) then[j] = q[j] + shift[j];
    return p->code[at + HK_MORE];
}

/* Go to the model within one whose actuator zeros have shifted, or whose base has moved: its place
   and its q, in `then` (n). Returns the motion of the base, R (3, 3) and p (3), or NULL. */
static inline const real *HK(within)(const hk_plan *p, int32_t *at, const V **q, V *then) {
    if (HK_IS(p, *at, HK_SHIFTED)) {
        *at = HK(before)(p, *at, *q, then);
        *q = then;
    }
    if (!HK_IS(p, *at, HK_MOVED)) return NULL;
    const real *R = hk_numbers(p, *at);
    *at = p->code[*at + HK_MORE];
    return R;
}

/* Vectors a (3, n), turned by R. */
static inline void HK(turn)(int n, const real *R, V *a) {
    for (int j = 0; j < n; j++) {
        const V v[3] = {a[j], a[n + j], a[2 * n + j]};
        for (int i = 0; i < 3; i++)
            a[n * i + j] = v[0] * R[3 * i] + v[1] * R[3 * i + 1] + v[2] * R[3 * i + 2];
    }
}

/* The error (6) of a pose model and its slope (6, n) where not NULL: a translation [m], and a rotation
   vector that the node's number, in 1/m, turns into radians. */
static inline void HK(pose_error)(const hk_plan *p, int at, const V *q, V *e, V *slope, V *distance,
                                  V *work) {
    const int32_t *more = p->code + at + HK_MORE;
    const real radians = hk_numbers(p, at)[0];
    HK(hybrid)(p, more[1], q, e, slope, distance, work);
    for (int i = 3; i < 6; i++) e[i] = e[i] * radians;
    for (int i = 3 * p->code[at + HK_N]; slope && i < 6 * p->code[at + HK_N]; i++)
        slope[i] = slope[i] * radians;
}

/* Any model but those that hold several, or another one. */
static inline void HK(single)(const hk_plan *p, int at, const V *q, V *x, V *J, V *distance,
                              V *work) {
    const int n = p->code[at + HK_N];
    if (distance) *distance = SPLAT(0.0);
    if (HK_IS(p, at, HK_HYBRID))
        HK(hybrid)(p, at, q, x, J, distance, work);
    else if (HK_IS(p, at, HK_ARCS) || HK_IS(p, at, HK_ELASTIC) || HK_IS(p, at, HK_RIGID) ||
             HK_IS(p, at, HK_STRUCTURAL))
        HK(chain)(p, at, q, x, J, work);
    else if (HK_IS(p, at, HK_WITH_POSE)) {
        V *e = HK(take)(&work, 6), *slope = HK(take)(&work, 6 * n);
        HK(chain)(p, p->code[at + HK_MORE], q, x, J, work);
        HK(pose_error)(p, at, q, e, J ? slope : NULL, distance, work);
        for (int i = 0; i < 3; i++) x[i] = x[i] + e[i];
        if (J) HK(add)(3 * n, R(1.0), slope, J);
    } else
        HK(regress)(p, at, q, x, J, NULL, work);
}

/* The number of models side by side in a node, and their places. */
static inline int HK(stack)(const hk_plan *p, const int32_t *at, const int32_t **places) {
    const int stacked = HK_IS(p, *at, HK_STACKED);
    *places = stacked ? p->code + *at + HK_MORE + 1 : at;
    return stacked ? p->code[*at + HK_MORE] : 1;
}

/* x (m) of q (n); the Jacobian J (m, n) and the domain distance where not NULL. x is R f(q + shift)
   + p, where base and actuator zeros have changed. */
static inline void HK(model)(const hk_plan *p, int at, const V *q, V *x, V *J, V *distance,
                             V *work) {
    const int n = p->code[at + HK_N], m = p->code[at + HK_M];
    const int32_t *places;
    int32_t inner = at;
    V *then = HK(take)(&work, n), here;
    const real *R = HK(within)(p, &inner, &q, then);
    const int count = HK(stack)(p, &inner, &places);
    for (int k = 0, row = 0; k < count; row += p->code[places[k++] + HK_M]) {
        HK(single)(p, places[k], q, x + row, J ? J + row * n : NULL, distance ? &here : NULL, work);
        if (distance) *distance = k ? SELECT(NOT(here <= *distance), here, *distance) : here;
    }
    if (!R) return;
    for (int k = 0; k < m; k += 3) {
        HK(turn)(1, R, x + k);
        for (int i = 0; i < 3; i++) x[k + i] = x[k + i] + R[9 + i];
        if (J) HK(turn)(n, R, J + n * k);
    }
}

/* a (3, n) <- a + f w x a + g w x (w x a), for each column: exp(w) a where f and g are those of w. */
static inline void HK(turn_by)(int n, const V *w, V f, V g, V *a) {
    for (int j = 0; j < n; j++) {
        const V v[3] = {a[j], a[n + j], a[2 * n + j]};
        V once[3], twice[3];
        HK(cross)(w, v, once);
        HK(cross)(w, once, twice);
        for (int i = 0; i < 3; i++) a[n * i + j] = v[i] + f * once[i] + g * twice[i];
    }
}

/* The pose of the tip: x (3), its axes `turn` (3, 3), and their motion and angular velocity J (6, n)
   and the domain distance where not NULL. */
static inline void HK(pose)(const hk_plan *p, int at, const V *q, V *x, V *turn, V *J, V *distance,
                            V *work) {
    const int n = p->code[at + HK_N];
    int32_t inner = at;
    V *then = HK(take)(&work, n);
    const real *R = HK(within)(p, &inner, &q, then);
    at = inner;
    if (distance) *distance = SPLAT(0.0);
    if (HK_IS(p, at, HK_WITH_POSE)) {
        V *e = HK(take)(&work, 6), *slope = HK(take)(&work, 6 * n);
        HK(chain_pose)(p, p->code[at + HK_MORE], q, x, turn, J, work);
        HK(pose_error)(p, at, q, e, J ? slope : NULL, distance, work);
        const V *w = e + 3;
        const HK(stumpff_t) a = HK(stumpff)(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
        for (int i = 0; i < 3; i++) x[i] = x[i] + e[i];
        HK(turn_by)(3, w, a.f, a.g, turn);
        if (J) { /* exp(w) omega + J_l(w) dw/dq, with the left Jacobian of the rotations */
            HK(turn_by)(n, w, a.f, a.g, J + 3 * n);
            HK(turn_by)(n, w, a.g, a.c3, slope + 3 * n);
            HK(add)(6 * n, R(1.0), slope, J);
        }
    } else
        HK(chain_pose)(p, at, q, x, turn, J, work);
    if (!R) return;
    HK(turn)(1, R, x);
    for (int i = 0; i < 3; i++) x[i] = x[i] + R[9 + i];
    HK(turn)(3, R, turn);
    for (int k = 0; J && k < 6; k += 3) HK(turn)(n, R, J + n * k);
}

/* The largest distance of any guard, and its slope (n) by q where not NULL. */
static inline void HK(domain)(const hk_plan *p, int at, const V *q, V *distance, V *slope,
                              V *work) {
    const int n = p->code[at + HK_N];
    const int32_t *places;
    int32_t inner = at;
    V *then = HK(take)(&work, n), *own = HK(take)(&work, n), here;
    HK(within)(p, &inner, &q, then);
    if (HK_IS(p, inner, HK_WITH_POSE)) inner = p->code[inner + HK_MORE + 1];
    const int count = HK(stack)(p, &inner, &places);
    for (int k = 0; k < count; k++) {
        HK(farthest)(p, places[k], q, k ? &here : distance, k && slope ? own : slope, work);
        if (k == 0) continue;
        const M farther = NOT(here <= *distance);
        *distance = SELECT(farther, here, *distance);
        for (int j = 0; slope && j < n; j++) slope[j] = SELECT(farther, own[j], slope[j]);
    }
}
