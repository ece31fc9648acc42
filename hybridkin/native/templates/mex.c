/* @NAME@ for MATLAB and Octave: mex @NAME@.c; help is in @NAME@.m. Written by hybridkin @VERSION@. */
#include <mex.h>
#include <string.h>

@MODEL_C@
/* The call from MATLAB or Octave. */

/* Numbers of an argument, or an error that says what is needed. */
static const double *numbers(const mxArray *argument, size_t size, const char *need) {
    if (!mxIsDouble(argument) || mxIsComplex(argument) || mxIsSparse(argument) ||
        mxGetNumberOfElements(argument) != size)
        mexErrMsgIdAndTxt("@NAME@:argument", "%s", need);
    return mxGetPr(argument);
}

static void give(int n_out, mxArray *out[], int which, size_t rows, size_t columns,
                 const @REAL@ *values) {
    if (which > 0 && which >= n_out) return;
    out[which] = mxCreateDoubleMatrix(rows, columns, mxREAL);
    double *to = mxGetPr(out[which]); /* column by column; values are row by row */
    for (size_t i = 0; i < rows; i++)
        for (size_t j = 0; j < columns; j++) to[i + rows * j] = (double)values[columns * i + j];
}

/* [x, J, distance] = @NAME@(q) */
static void evaluate(int n_out, mxArray *out[], const mxArray *argument) {
    const double *given = numbers(argument, @N@, "@NAME@(q): q must hold @N@ numbers.");
    @REAL@ q[@N@], x[@M@], J[@M@ * @N@], distance;
    for (int j = 0; j < @N@; j++) q[j] = (@REAL@)given[j];
    @NAME@_jacobian(q, x, J);
    distance = @NAME@_domain(q);
    give(n_out, out, 0, @M@, 1, x);
    give(n_out, out, 1, @M@, @N@, J);
    give(n_out, out, 2, 1, 1, &distance);
}
@STEP_MEX@
void mexFunction(int n_out, mxArray *out[], int n_in, const mxArray *in[]) {
    if (n_in == 1 && !mxIsChar(in[0])) {
        evaluate(n_out, out, in[0]);
        return;
    }
@STEP_CALL@
    mexErrMsgIdAndTxt("@NAME@:call", "Unknown call; see: help @NAME@");
}
