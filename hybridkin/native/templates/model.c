/* @TITLE@: written by hybridkin @VERSION@. Units and limits: README.md. */
#include "@NAME@.h"

@DEFINES@
#include "plan.h"
#include "row.h"
#include "model.h"

static const int32_t code[] = {@CODE@};

static const real data[] = {@DATA@};

const @REAL@ @NAME@_home[@N@] = {@HOME@};

static const hk_plan plan = {code, data, 0};

/* Numbers of memory to compute in, on the stack. */
enum { WORK = HK_MODEL_WORK(HK_MAX_N, HK_MAX_S, HK_MAX_M, HK_MAX_F) };

void @NAME@_forward(const @REAL@ *q, @REAL@ *x) {
    real work[WORK];
    hk_model(&plan, @MODEL@, q, x, NULL, NULL, work);
}

void @NAME@_jacobian(const @REAL@ *q, @REAL@ *x, @REAL@ *J) {
    real work[WORK];
    hk_model(&plan, @MODEL@, q, x, J, NULL, work);
}

@REAL@ @NAME@_domain(const @REAL@ *q) {
    real work[WORK], distance;
    hk_domain(&plan, @MODEL@, q, &distance, NULL, work);
    return distance;
}
@STEP_C@
