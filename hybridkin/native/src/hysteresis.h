/* Hysteresis between the commands of n actuators and what they do: stages in series.

   A description begins with the number of stages and the number of rows of the state. For each stage
   follow its kernel, its number of rows inside of the state, and its number of numbers. The kernel
   NAME is in stage_NAME.h: `hk_NAME_apply` follows commands u (n) with what is `inside` (count, n), and
   sets the result y (n); `hk_NAME_command` is its inverse, which turns the result that is the `goal` (n)
   into the commands for it, with u (n) as the commands before, and follows these.

   The state has rows of n numbers: the command; then of every stage what is inside, and its result,
   which is the command of the next stage. The last row is what the actuators do. At the start without
   hysteresis all rows are the command. */

enum { HK_STAGES, HK_STATE_ROWS, HK_FIRST_STAGE };
enum { HK_WHICH, HK_INSIDE, HK_NUMBERS, HK_PER_STAGE };

typedef struct {
    const int32_t *code;
    const real *numbers;
    int n;
    real rounding; /* of a result of creep, relative to its parts */
} hk_hysteresis;

/* One of the stages, `seconds` after the row before. */
typedef struct {
    int n, count; /* actuators, rows inside */
    const real *numbers;
    real seconds, rounding;
} hk_stage;

static inline real hk_larger(real a, real b) { return a > b ? a : b; }

#include "stages.h"

static inline void hk_stage_apply(int which, const hk_stage *s, const real *u, real *inside,
                                  real *y) {
#define HK_APPLY(WHICH, name)                                                                      \
    if (which == WHICH) hk_##name##_apply(s, u, inside, y);
    HK_EACH_STAGE(HK_APPLY)
#undef HK_APPLY
}

static inline void hk_stage_command(int which, const hk_stage *s, const real *u, real *inside,
                                    real *y, real *goal) {
#define HK_COMMAND(WHICH, name)                                                                    \
    if (which == WHICH) hk_##name##_command(s, u, inside, y, goal);
    HK_EACH_STAGE(HK_COMMAND)
#undef HK_COMMAND
}

/* Follow the command in the first row of the state, `seconds` after the one before. */
static inline void hk_hysteresis_apply(const hk_hysteresis *h, real seconds, real *state) {
    const int32_t *code = h->code + HK_FIRST_STAGE;
    hk_stage s = {h->n, 0, h->numbers, seconds, h->rounding};
    for (int i = 0; i < h->code[HK_STAGES]; i++, code += HK_PER_STAGE) {
        s.count = code[HK_INSIDE];
        real *inside = state + h->n, *y = inside + s.count * h->n;
        hk_stage_apply(code[HK_WHICH], &s, state, inside, y);
        s.numbers += code[HK_NUMBERS];
        state = y;
    }
}

/* The inverse: `goal` (n), what the actuators are to do, becomes the commands for it, and the state
   follows. An actuator that is to stay keeps its command, unless it creeps. */
static inline void hk_hysteresis_command(const hk_hysteresis *h, real seconds, real *goal,
                                         real *state) {
    const int n = h->n, count = h->code[HK_STAGES];
    const int32_t *code = h->code + HK_FIRST_STAGE;
    hk_stage s = {n, 0, h->numbers, seconds, h->rounding};
    real *y = state + (h->code[HK_STATE_ROWS] - 1) * n;
    for (int i = 0; i < count; i++, code += HK_PER_STAGE) s.numbers += code[HK_NUMBERS];
    for (int i = 0; i < count; i++) {
        code -= HK_PER_STAGE;
        s.count = code[HK_INSIDE];
        s.numbers -= code[HK_NUMBERS];
        real *inside = y - s.count * n, *u = inside - n;
        hk_stage_command(code[HK_WHICH], &s, u, inside, y, goal);
        y = u;
    }
    for (int j = 0; j < n; j++) state[j] = goal[j];
}
