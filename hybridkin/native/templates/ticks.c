
#define STEPS_ARE_CHECKED
/* Runs of steps: the start, then for every step the target, dx, measured tip, and the expected
   command and square of the smallest singular value. From run COMPARED on only the limits are
   checked. */
enum { RUNS = 8, STEPS = @STEPS@, COMPARED = @COMPARED@ };
static const @REAL@ low[N] = {@LOW@};
static const @REAL@ high[N] = {@HIGH@};
static const @REAL@ starts[RUNS * N] = {@STARTS@};
enum { TARGET = @WIDTH@, TASK = @TASK@ };
static const @REAL@ target[RUNS * STEPS * TARGET] = {@TARGET@};
static const @REAL@ dx[RUNS * STEPS * TASK] = {@DX@};
static const @REAL@ measured[RUNS * STEPS * TARGET] = {@MEASURED_TIPS@};
static const double command[RUNS * STEPS * N] = {@COMMAND@};
static const double sigma_min_sq[RUNS * STEPS] = {@SIGMA_SQ@};

static void check_steps(double *worst) {
    for (int run = 0; run < RUNS; run++) {
        @NAME@_state state;
        @NAME@_reset(&state, starts + N * run);
        state.memory = (@REAL@)@MEMORY@;
        state.delay = (@REAL@)@DELAY@;
        for (int i = STEPS * run; i < STEPS * (run + 1); i++) {
            const int reads = i % STEPS < STEPS - 1; /* the last one without a measured tip */
            @NAME@_step(&state, target + TARGET * i, dx + TASK * i,
                reads ? measured + TARGET * i : NULL);
            const @REAL@ square = state.sigma_min * state.sigma_min;
            for (int j = 0; j < N; j++)
                if (!(state.q[j] >= low[j] && state.q[j] <= high[j])) {
                    printf("step %d, actuator %d: %g is not within the limits\n", i, j,
                           (double)state.q[j]);
                    failures++;
                }
            if (run >= COMPARED) continue;
            check("step", i, state.q, command + N * i, N, @Q_SCALE@, worst);
            check("sigma_min^2", i, &square, sigma_min_sq + i, 1, @J_SCALE@ * @J_SCALE@, worst);
            for (int j = 0; j < N; j++) state.q[j] = (@REAL@)command[N * i + j];
        }
    }
}
