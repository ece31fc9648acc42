/* Hysteresis between the commands of n actuators and what they do: stages in series, each a weighted
   sum of plays, or creep.

   A description begins with the number of stages and the number of rows of the state. For each stage
   follows a count: K > 0 for a sum of K plays, -J for creep with J time constants. Its numbers are,
   stage by stage, half the widths (K, n), ascending, and the slopes (K, n), of which the last are 1;
   or gains (J, n) and time constants (J).

   The state has rows of n numbers: the command; then of every stage the plays (K) or slow parts (J),
   and its result, which is the command of the next stage. The last row is what the actuators do. At
   the start without hysteresis all rows are the command. */

enum { HK_STAGES, HK_STATE_ROWS, HK_STAGE };

typedef struct {
    const int32_t *code;
    const real *numbers;
    int n;
    real rounding; /* of a result of creep, relative to its parts */
} hk_hysteresis;

static inline real hk_larger(real a, real b) { return a > b ? a : b; }

static inline int hk_stage_rows(int count) { return count < 0 ? -count : count; }

/* What of a change is still to come after some seconds, for each of the time constants. */
static inline void hk_late(int count, const real *times, real seconds, real *late) {
    for (int i = 0; i < count; i++) late[i] = HK_MATH(exp)(-seconds / times[i]);
}

/* Plays that follow commands u (n), and their weighted sum y (n). */
static inline void hk_plays_apply(int n, int count, const real *half, const real *slopes,
                                  const real *u, real *plays, real *y) {
    for (int j = 0; j < n; j++) y[j] = R(0.0);
    for (int at = 0; at < count * n; at += n)
        for (int j = 0; j < n; j++) {
            const real low = u[j] - half[at + j], high = u[j] + half[at + j];
            const real before = at ? slopes[at + j - n] : R(0.0);
            real play = plays[at + j];
            play = play < low ? low : play; /* a NaN stays */
            play = high < play ? high : play;
            plays[at + j] = play;
            y[j] += (slopes[at + j] - before) * play;
        }
}

/* The sums y (n) become `goal` (n), and that the commands for them; u (n) are the commands before.
   Along the direction of an actuator the plays begin to move in the order of their widths, and y is
   piecewise linear in u. The pieces ascend, also after rounding: then the one that holds the goal has
   a slope, and the command is within it. */
static inline void hk_plays_command(int n, int count, const real *half, const real *slopes,
                                    const real *u, real *plays, real *y, real *goal) {
    for (int j = 0; j < n; j++) {
        const real to = goal[j], side = to > y[j] ? R(1.0) : R(-1.0);
        real from = hk_larger(side * plays[j] + half[j], side * u[j]), end = from;
        real level = side * y[j], lag = slopes[j] * half[j], slope = slopes[j];
        int at = j + n;
        for (; at < count * n; at += n) {
            end = hk_larger(side * plays[at] + half[at], from);
            const real next = level + slope * (end - from);
            if (!(next < side * to)) break;
            from = end, level = next;
            lag += (slopes[at] - slope) * half[at], slope = slopes[at];
        }
        if (to == y[j])
            goal[j] = u[j];
        else if (at < count * n) {
            const real ahead = from + (side * to - level) / slope;
            goal[j] = side * (ahead < end ? ahead : end);
        } else /* all of them move */
            goal[j] = side * hk_larger(side * to + lag, from);
        y[j] = to;
    }
    for (int at = 0; at < count * n; at += n)
        for (int j = 0; j < n; j++) {
            const real low = goal[j] - half[at + j], high = goal[j] + half[at + j];
            plays[at + j] = plays[at + j] < low ? low : plays[at + j];
            plays[at + j] = high < plays[at + j] ? high : plays[at + j];
        }
}

static inline void hk_creep_apply(int n, int count, const real *gains, const real *times,
                                  real seconds, const real *u, real *slow, real *y) {
    real late[HK_MAX_CREEPS];
    hk_late(count, times, seconds, late);
    for (int j = 0; j < n; j++) y[j] = u[j];
    for (int i = 0; i < count; i++, slow += n, gains += n)
        for (int j = 0; j < n; j++) {
            const real behind = late[i] * (slow[j] - u[j]);
            slow[j] = u[j] + behind;
            y[j] += gains[j] * behind;
        }
}

/* As `hk_plays_command`. */
static inline void hk_creep_command(int n, int count, const real *gains, const real *times,
                                    real seconds, real rounding, const real *u, real *slow, real *y,
                                    real *goal) {
    real late[HK_MAX_CREEPS];
    hk_late(count, times, seconds, late);
    for (int j = 0; j < n; j++) {
        real at_once = R(1.0), from = R(0.0), size = hk_larger(goal[j], -goal[j]);
        for (int i = 0; i < count; i++) {
            const real share = gains[n * i + j] * late[i], part = share * slow[n * i + j];
            at_once -= share, from += part, size += hk_larger(part, -part);
        }
        /* Rounding is no reversal, after which a backlash before this stage would jump, and a share
           at once that is only rounding moves nothing. */
        const real stay = from + at_once * u[j], change = goal[j] - stay;
        const int moves = at_once > rounding && hk_larger(change, -change) > rounding * size;
        y[j] = moves ? goal[j] : stay;
        goal[j] = moves ? (goal[j] - from) / at_once : u[j];
    }
    for (int i = 0; i < count; i++, slow += n)
        for (int j = 0; j < n; j++) slow[j] = goal[j] + late[i] * (slow[j] - goal[j]);
}

/* Follow the command in the first row of the state, `seconds` after the one before. */
static inline void hk_hysteresis_apply(const hk_hysteresis *h, real seconds, real *state) {
    const real *a = h->numbers;
    const int n = h->n;
    for (int i = 0; i < h->code[HK_STAGES]; i++) {
        const int count = h->code[HK_STAGE + i], size = n * hk_stage_rows(count);
        real *inside = state + n, *y = inside + size;
        if (count > 0)
            hk_plays_apply(n, count, a, a + size, state, inside, y);
        else
            hk_creep_apply(n, -count, a, a + size, seconds, state, inside, y);
        a += size + (count > 0 ? size : -count);
        state = y;
    }
}

/* The inverse: `goal` (n), what the actuators are to do, becomes the commands for it, and the state
   follows. An actuator that is to stay keeps its command, unless it creeps. */
static inline void hk_hysteresis_command(const hk_hysteresis *h, real seconds, real *goal,
                                         real *state) {
    const int n = h->n, rows = h->code[HK_STATE_ROWS];
    const real *a = h->numbers;
    real *y = state + (rows - 1) * n;
    for (int i = 0; i < h->code[HK_STAGES]; i++) {
        const int count = h->code[HK_STAGE + i];
        a += n * hk_stage_rows(count) + (count > 0 ? n * count : -count);
    }
    for (int i = h->code[HK_STAGES] - 1; i >= 0; i--) {
        const int count = h->code[HK_STAGE + i], size = n * hk_stage_rows(count);
        real *inside = y - size, *u = inside - n;
        a -= size + (count > 0 ? size : -count);
        if (count > 0)
            hk_plays_command(n, count, a, a + size, u, inside, y, goal);
        else
            hk_creep_command(n, -count, a, a + size, seconds, h->rounding, u, inside, y, goal);
        y = u;
    }
    for (int j = 0; j < n; j++) state[j] = goal[j];
}
