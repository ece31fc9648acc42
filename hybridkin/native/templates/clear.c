
void @NAME@_obstacle(@NAME@_state *state, int i, const @REAL@ *numbers) {
    for (int k = 0; i >= 0 && i < @OBSTACLES@ && k < IK_OBSTACLE; k++)
        state->obstacles[IK_OBSTACLE * i + k] = numbers[k];
}
