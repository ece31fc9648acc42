/* The outputs of the inputs as they are. */
static void start_unit(instance_t *unit) {
    double *values = unit->values;
    @NAME@_jacobian(values + V_Q, values + V_X, values + V_JACOBIAN);
    values[V_DOMAIN_DISTANCE] = @NAME@_domain(values + V_Q);
}

static int check_together(const instance_t *unit) {
    (void)unit;
    return FMI_OK;
}

static int step_unit(instance_t *unit, double step) {
    (void)step;
    start_unit(unit);
    return FMI_OK;
}
