
/* The state of a controller travels as its bytes. */
static mxArray *packed(const @NAME@_state *state) {
    mxArray *bytes = mxCreateNumericMatrix(sizeof *state, 1, mxUINT8_CLASS, mxREAL);
    memcpy(mxGetData(bytes), state, sizeof *state);
    return bytes;
}

/* state = @NAME@('reset', q) */
static void reset(mxArray *out[], const mxArray *argument) {
    const double *given = numbers(argument, @N@, "@NAME@('reset', q): q must hold @N@ numbers.");
    @NAME@_state state;
    @REAL@ q[@N@];
    for (int j = 0; j < @N@; j++) {
        q[j] = (@REAL@)given[j];
        if (!isfinite(q[j])) mexErrMsgIdAndTxt("@NAME@:argument", "@NAME@('reset', q): q must be finite.");
    }
    @NAME@_reset(&state, q);
    out[0] = packed(&state);
}

/* [q, state, error, held, rejected] = @NAME@('step', state, target, velocity, measured, age) */
static void step(int n_out, mxArray *out[], int n_in, const mxArray *in[]) {
    @NAME@_state state;
    @REAL@ target[@WIDTH@], velocity[@TASK@], measured[@WIDTH@], held[@N@];
    if (!mxIsUint8(in[1]) || mxGetNumberOfElements(in[1]) != sizeof state)
        mexErrMsgIdAndTxt("@NAME@:state", "state must come from @NAME@('reset', q) or a step.");
    memcpy(&state, mxGetData(in[1]), sizeof state);
    const double *goal = numbers(in[2], @WIDTH@, "target must hold @WIDTH@ numbers.");
    for (int i = 0; i < @WIDTH@; i++) target[i] = (@REAL@)goal[i];
    const int moves = n_in > 3 && !mxIsEmpty(in[3]), sees = n_in > 4 && !mxIsEmpty(in[4]);
    if (moves) {
        const double *speed = numbers(in[3], @TASK@, "velocity must hold @TASK@ numbers, or be [].");
        for (int i = 0; i < @TASK@; i++) velocity[i] = (@REAL@)speed[i];
    }
    if (sees) {
        const double *tip = numbers(in[4], @WIDTH@, "measured must hold @WIDTH@ numbers, or be [].");
        for (int i = 0; i < @WIDTH@; i++) measured[i] = (@REAL@)tip[i];
    }
    if (n_in > 5) state.delay = (@REAL@)*numbers(in[5], 1, "age must be a time [s].");
    @NAME@_step(&state, target, moves ? velocity : NULL, sees ? measured : NULL);
    const @REAL@ rejected = (@REAL@)state.rejected;
    for (int j = 0; j < @N@; j++) held[j] = (@REAL@)state.held[j];
    give(n_out, out, 0, @N@, 1, state.q);
    if (n_out > 1) out[1] = packed(&state);
    give(n_out, out, 2, 1, 1, &state.error);
    give(n_out, out, 3, @N@, 1, held);
    give(n_out, out, 4, 1, 1, &rejected);
@GIVE_BLOCKED@}
@CLEAR_MEX@