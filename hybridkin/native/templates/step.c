
#include "ik_step.h"

static void ik_model(const ik_settings *ik, const real *q, real *x, real *J) {
#if HK_POSES
    real tip[3], turn[9];
    hk_pose(&plan, @MODEL@, q, tip, turn, J, NULL, ik->work);
    ik_pose_of(ik, tip, turn, x);
#else
    hk_model(&plan, @MODEL@, q, x, J, NULL, ik->work);
#endif
}

/* Numbers of memory for a step, on the stack. */
enum { STEP_WORK = WORK + IK_SLOTS_WORK(@N@, @TASK@, @NORMALS@, @POINTS@, @PAIRS@) };

/* Numbers of the state of hysteresis, and what the actuators do, where the model is evaluated. */
enum { LEAD = @LEAD@ };
#if HK_HYSTERESIS
#define EFFECTIVE(state) ((state)->hysteresis + LEAD - @N@)
#else
#define EFFECTIVE(state) ((state)->q)
#endif

void @NAME@_reset(@NAME@_state *state, const @REAL@ *q) {
    const @NAME@_state none = {0};
    real work[STEP_WORK], J[@TASK@ * @N@];
    const ik_settings ik = ik_settings_of(code, data, @ROOT@, work);
    *state = none;
    for (int j = 0; j < @N@; j++) state->q[j] = q[j];
#if HK_HYSTERESIS
    for (int i = 0; i < LEAD; i++) state->hysteresis[i] = q[i % @N@];
#endif
#if HK_OBSTACLES
    for (int i = 0; i < IK_OBSTACLE * @OBSTACLES@; i++) state->obstacles[i] = ik.scene[i];
#endif
    state->memory = state->seen[IK_SINCE] = (real)INFINITY;
    ik_model(&ik, q, state->x, J);
    state->error = state->sigma_min = (real)NAN;
}

static void step_within(const ik_settings *ik, @NAME@_state *state, const @REAL@ *target,
    const @REAL@ *dx, const @REAL@ *measured) {
    real all[IK_STATE_SIZE(@N@, @TASK@, @WIDTH@) + 2 * LEAD] = {0};
    const ik_state now = ik_state_of(ik, all);
    for (int i = 0; i < @WIDTH@; i++) {
        now.target[i] = target[i];
        now.tip[i] = measured ? measured[i] : (real)0;
    }
    for (int i = 0; i < @TASK@; i++) {
        now.feed[i] = dx ? ik->dt * dx[i] : (real)0;
        now.offset[i] = state->offset[i];
    }
    for (int i = 0; i < IK_REST_SIZE(@TASK@); i++) now.rest[i] = state->rest[i];
    for (int i = 0; i < @WIDTH@; i++) now.x[i] = state->x[i];
    for (int j = 0; j < @N@; j++) {
        now.q[j] = state->q[j];
        now.dq[j] = state->dq[j];
    }
    all[IK_MODE] = (real)(IK_HAS_TARGET + (dx ? IK_HAS_FEED : 0) + (measured ? IK_HAS_TIP : 0));
#if HK_HYSTERESIS
    all[IK_MODE] += IK_LEADS;
    for (int i = 0; i < LEAD; i++) now.lead[i] = state->hysteresis[i];
#endif
    all[IK_PERIOD] = ik->dt;
    all[IK_MEMORY] = state->memory;
    state->seen[IK_AGE] = state->delay;
    if (!ik_tick(ik, all, state->seen)) { /* no rotation or direction: not known */
        for (int i = 0; i < @WIDTH@; i++) now.target[i] = now.tip[i] = (real)NAN;
        ik_tick(ik, all, state->seen);
    }
    state->rejected = state->seen[IK_REJECTED] > (real)0;
#if HK_HYSTERESIS
    for (int i = 0; i < LEAD; i++) state->hysteresis[i] = now.lead[i];
#endif
    for (int i = 0; i < @TASK@; i++) state->offset[i] = now.offset[i];
    for (int i = 0; i < IK_REST_SIZE(@TASK@); i++) state->rest[i] = now.rest[i];
    for (int i = 0; i < @WIDTH@; i++) state->x[i] = now.x[i];
    state->error = all[IK_DISTANCE];
    state->sigma_min = all[IK_SIGMA_MIN];
    state->damping = all[IK_DAMPING];
    state->stopped = all[IK_STOPPED] > (real)0;
#if HK_OBSTACLES
    state->blocked = all[IK_BLOCKED] > (real)0;
#endif
    for (int j = 0; j < @N@; j++) {
        state->q[j] = now.q[j];
        state->dq[j] = now.dq[j];
        state->held[j] = now.held[j] > (real)0;
    }
}

void @NAME@_step(@NAME@_state *state, const @REAL@ *target, const @REAL@ *dx,
    const @REAL@ *measured) {
    real work[STEP_WORK];
    ik_settings ik = ik_settings_of(code, data, @ROOT@, work);
#if HK_OBSTACLES
    ik.scene = state->obstacles;
#endif
    step_within(&ik, state, target, dx, measured);
}
@CLEAR_C@