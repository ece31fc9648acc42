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

/* x (m) of q (n); the Jacobian J (m, n) and the domain distance where not NULL. */
static inline void HK(model)(const hk_plan *p, int at, const V *q, V *x, V *J, V *distance) {
    if (distance) *distance = SPLAT(0.0);
    if (HK_IS(p, at, HK_HYBRID))
        HK(hybrid)(p, at, q, x, J, distance);
    else if (HK_IS(p, at, HK_ARCS) || HK_IS(p, at, HK_ELASTIC) || HK_IS(p, at, HK_RIGID))
        HK(chain)(p, at, q, x, J);
    else
        HK(regress)(p, at, q, x, J, NULL);
}
