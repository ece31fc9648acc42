/* @TITLE@: written by hybridkin @VERSION@. Units and limits: README.md. */
#include "@NAME@.h"

@DEFINES@
#include "plan.h"
#include "row.h"
#include "model.h"

static const int32_t code[] = {@CODE@};

static const real data[] = {@DATA@};

const @REAL@ @NAME@_home[@N@] = {@HOME@};

static const hk_plan plan = {code, data};

void @NAME@_forward(const @REAL@ *q, @REAL@ *x) { hk_model(&plan, @MODEL@, q, x, NULL, NULL); }

void @NAME@_jacobian(const @REAL@ *q, @REAL@ *x, @REAL@ *J) {
    hk_model(&plan, @MODEL@, q, x, J, NULL);
}

@REAL@ @NAME@_domain(const @REAL@ *q) {
    real distance;
    hk_domain(&plan, @MODEL@, q, &distance, NULL);
    return distance;
}
@STEP_C@
