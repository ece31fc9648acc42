/* Any model of a plan: value, Jacobian and domain distance of one row, or of HK_LANES rows. */

#include "lanes.h"
#include "linear.h"
#include "arcs.h"
#include "elastic.h"
#include "rigid.h"
#include "chains.h"
#include "pose.h"
#include "regressors.h"
#include "guards.h"
#include "hybrid.h"

/* x (m) of q (n); the Jacobian J (m, n) and the domain distance where not NULL. */
static inline void HK(model)(const hk_plan *p, int at, const V *q, V *x, V *J, V *distance) {
    if (distance) *distance = SPLAT(0.0);
    switch (p->code[at]) {
    case HK_ARCS:
    case HK_ELASTIC:
    case HK_RIGID: HK(chain)(p, at, q, x, J); break;
    case HK_HYBRID: HK(hybrid)(p, at, q, x, J, distance); break;
    case HK_AFFINE:
    case HK_ELM:
    case HK_POLYNOMIAL:
    case HK_KERNEL:
    case HK_READOUT: HK(regress)(p, at, q, x, J, NULL);
    }
}
