
#include "ik_step.h"

static void ik_model(const ik_settings *ik, const real *q, real *x, real *J, real *distance) {
    hk_model(&plan, @MODEL@, q, x, J, distance, ik->work);
}

void @NAME@_reset(@NAME@_state *state, const @REAL@ *q) {
    const @NAME@_state none = {0};
    *state = none;
    for (int j = 0; j < @N@; j++) state->q[j] = q[j];
    @NAME@_forward(q, state->x);
    state->error = state->sigma_min = (real)NAN;
}

void @NAME@_step(@NAME@_state *state, const @REAL@ *target, const @REAL@ *dx,
    const @REAL@ *measured) {
    real work[WORK], all[IK_STATE] = {0};
    const ik_settings ik = ik_settings_of(code, data, @ROOT@, work);
    for (int i = 0; i < 3; i++) {
        all[IK_TARGET + i] = target[i];
        all[IK_FEED + i] = dx ? ik.dt * dx[i] : (real)0;
        all[IK_TIP + i] = measured ? measured[i] : (real)0;
        all[IK_OFFSET + i] = state->offset[i];
    }
    for (int j = 0; j < @N@; j++) {
        all[IK_Q + j] = state->q[j];
        all[IK_Q + @N@ + j] = state->dq[j];
    }
    all[IK_MODE] = (real)(IK_HAS_TARGET + (dx ? IK_HAS_FEED : 0) + (measured ? IK_HAS_TIP : 0));
    all[IK_PERIOD] = ik.dt;
    all[IK_MEMORY] = state->memory;
    ik_tick(&ik, all);
    for (int i = 0; i < 3; i++) {
        state->offset[i] = all[IK_OFFSET + i];
        state->x[i] = all[IK_X + i];
    }
    state->error = all[IK_DISTANCE];
    state->sigma_min = all[IK_SIGMA_MIN];
    state->damping = all[IK_DAMPING];
    for (int j = 0; j < @N@; j++) {
        state->q[j] = all[IK_Q + j];
        state->dq[j] = all[IK_Q + @N@ + j];
        state->held[j] = all[IK_Q + 3 * @N@ + j] > (real)0;
    }
}
