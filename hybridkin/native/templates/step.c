
void @NAME@_reset(@NAME@_state *state, const @REAL@ *q) {
    const @NAME@_state none = {0};
    *state = none;
    for (int j = 0; j < @N@; j++) state->q[j] = q[j];
    @NAME@_forward(q, state->x);
    state->error = state->sigma_min = (real)NAN;
}

void @NAME@_step(@NAME@_state *state, const @REAL@ *target, const @REAL@ *dx,
    const @REAL@ *measured) {
    const ik_settings ik = ik_settings_of(code, data, @ROOT@);
    real all[HK_STATE] = {0};
    for (int i = 0; i < 3; i++) {
        all[HK_TARGET + i] = target[i];
        all[HK_FEED + i] = dx ? ik.dt * dx[i] : (real)0;
        all[HK_TIP + i] = measured ? measured[i] : (real)0;
        all[HK_OFFSET + i] = state->offset[i];
    }
    for (int j = 0; j < @N@; j++) all[HK_Q + j] = state->q[j];
    all[HK_MODE] = (real)(HK_HAS_TARGET + (dx ? HK_HAS_FEED : 0) + (measured ? HK_HAS_TIP : 0));
    all[HK_PERIOD] = ik.dt;
    all[HK_MEMORY] = state->memory;
    ik_tick(&ik, all);
    for (int i = 0; i < 3; i++) {
        state->offset[i] = all[HK_OFFSET + i];
        state->x[i] = all[HK_X + i];
    }
    state->error = all[HK_DISTANCE];
    state->sigma_min = all[HK_SIGMA_MIN];
    state->damping = all[HK_DAMPING];
    for (int j = 0; j < @N@; j++) {
        state->q[j] = all[HK_Q + j];
        state->held[j] = all[HK_Q + 3 * @N@ + j] > (real)0;
    }
}
