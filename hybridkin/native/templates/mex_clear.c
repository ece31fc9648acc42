
/* state = @NAME@('obstacle', state, i, numbers) */
static void obstacle(mxArray *out[], const mxArray *in[]) {
    @NAME@_state state;
    @REAL@ to[IK_OBSTACLE];
    if (!mxIsUint8(in[1]) || mxGetNumberOfElements(in[1]) != sizeof state)
        mexErrMsgIdAndTxt("@NAME@:state", "state must come from @NAME@('reset', q) or a step.");
    memcpy(&state, mxGetData(in[1]), sizeof state);
    const double which = *numbers(in[2], 1, "i must be the number of an obstacle.");
    const double *given = numbers(in[3], IK_OBSTACLE, "numbers must be the 19 of an obstacle.");
    if (!(which >= 1 && which <= @OBSTACLES@ && which == (int)which))
        mexErrMsgIdAndTxt("@NAME@:argument", "i must be from 1 to @OBSTACLES@.");
    for (int k = 0; k < IK_OBSTACLE; k++) to[k] = (@REAL@)given[k];
    @NAME@_obstacle(&state, (int)which - 1, to);
    out[0] = packed(&state);
}
