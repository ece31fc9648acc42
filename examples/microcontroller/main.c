/* Prints what the exported code computes, bit by bit in hexadecimal numbers.

   Rows around the typical q, their tips and Jacobians; with STEPS also a run of a controller. */
#include <stdint.h>
#include <string.h>

#include "model.h"

void say(const char *text);

static void show(const float *values, int n) {
    char line[9 * 8 + 2];
    int at = 0;
    for (int i = 0; i < n; i++) {
        uint32_t bits;
        memcpy(&bits, values + i, sizeof bits);
        for (int shift = 28; shift >= 0; shift -= 4) line[at++] = "0123456789abcdef"[bits >> shift & 15];
        line[at++] = ' ';
        if (i == n - 1 || i % 8 == 7) {
            line[at++] = '\n';
            line[at] = 0;
            say(line);
            at = 0;
        }
    }
}

int main(void) {
    float q[MODEL_N], x[MODEL_OUTPUTS], J[MODEL_OUTPUTS * MODEL_N];
    for (int row = 0; row < ROWS; row++) {
        for (int j = 0; j < MODEL_N; j++)
            q[j] = model_home[j] * (1.0f + 0.02f * (float)((row * 7 + j * 5) % 11 - 5));
        model_jacobian(q, x, J);
        show(q, MODEL_N);
        show(x, MODEL_OUTPUTS);
        show(J, MODEL_OUTPUTS * MODEL_N);
    }
#ifdef STEPS
    model_state state;
    model_reset(&state, model_home);
    float target[MODEL_TARGET];
    memcpy(target, state.x, sizeof target);
    for (int step = 0; step < STEPS; step++) {
        target[step % 2] += 1e-4f;
        model_step(&state, target, 0, 0);
        show(state.q, MODEL_N);
    }
#endif
    return 0;
}
