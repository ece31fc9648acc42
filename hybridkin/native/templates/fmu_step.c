/* The command, the tip that the model predicts for it, and what is known of the last step. */
static void write_outputs(instance_t *unit) {
    double *values = unit->values;
    real work[STEP_WORK], J[@TASK@ * @N@];
    const ik_settings ik = ik_settings_of(code, data, @ROOT@, work);
    values[V_STATUS] = isnan(unit->state.sigma_min) ? 2.0 : 0.0;
    for (int j = 0; j < @N@; j++) {
        values[V_COMMAND + j] = unit->state.q[j];
        if (unit->state.held[j] && values[V_STATUS] == 0.0) values[V_STATUS] = 1.0;
    }
    ik_model(&ik, EFFECTIVE(&unit->state), values + V_TIP, J);
#if HK_HYSTERESIS
    for (int j = 0; j < @N@; j++) values[V_EFFECTIVE + j] = EFFECTIVE(&unit->state)[j];
#endif
    values[V_ERROR] = unit->state.error;
    values[V_REJECTED] = unit->state.rejected;
#if HK_OBSTACLES
    values[V_BLOCKED] = unit->state.blocked;
#endif
}

/* At rest at the start command. */
static void start_unit(instance_t *unit) {
    @NAME@_reset(&unit->state, unit->values + V_START);
    write_outputs(unit);
    unit->values[V_STATUS] = 0.0;
}

/* The settings, with the limits and gains of the instance. */
static ik_settings settings_of(const instance_t *unit, real *work) {
    const double *values = unit->values;
    ik_settings ik = ik_settings_of(code, data, @ROOT@, work);
@PARAMETERS@
#if HK_OBSTACLES
    ik.scene = unit->state.obstacles;
#endif
    ik.gain = values[V_GAIN];
    ik.beta = values[V_BETA];
    ik.fraction = values[V_FRACTION];
    return ik;
}

/* Check parameters against each other, which an importer sets one by one. */
static int check_together(const instance_t *unit) {
    real work[STEP_WORK];
    const ik_settings ik = settings_of(unit, work);
    for (int j = 0; ik.flags & IK_LIMITED && j < @N@; j++)
        if (!(ik.low[j] <= ik.high[j]))
            return refused(unit, "q_min must not exceed q_max, got %g and %g", ik.low[j],
                           ik.high[j]);
    return FMI_OK;
}

/* As many periods as fit into the step. */
static int step_unit(instance_t *unit, double step) {
    const double *values = unit->values;
    const double periods = floor(step / @DT@ + 0.5);
    real work[STEP_WORK];
    const ik_settings ik = settings_of(unit, work);
    if (!(periods >= 1.0 && periods <= 1e9 && fabs(step - periods * @DT@) <= 1e-6 * step))
        return refused(unit, "a step must be a multiple of %g s, got %g s", @DT@, step);
    unit->state.memory = values[V_MEMORY] > 0.0 ? values[V_MEMORY] : INFINITY;
    unit->state.delay = values[V_DELAY];
#if @OBSTACLES@
    for (int i = 0; i < @OBSTACLES@; i++)
        for (int k = 0; k < 3; k++)
            unit->state.obstacles[IK_OBSTACLE * i + k] = values[V_OBSTACLES + 3 * i + k];
#endif
    /* A measurement is that of one period; without any, the error is that of the model. */
    int known = 0;
    for (int i = 0; i < @WIDTH@; i++) known += !isnan(values[V_MEASURED + i]);
    for (int k = 0; k < (int)periods; k++)
        step_within(&ik, &unit->state, values + V_TARGET, values + V_VELOCITY,
                    k == 0 && known ? values + V_MEASURED : NULL);
    write_outputs(unit);
    return FMI_OK;
}
