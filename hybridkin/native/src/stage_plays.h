/* A stage of hysteresis: plays, and a weighted sum of them. Its numbers are half the widths (count, n),
   ascending, and the slopes (count, n), of which the last are 1. */

/* The plays (count, n) after commands u (n), and their weighted sum y (n). */
static inline void hk_plays_apply(const hk_stage *s, const real *u, real *plays, real *y) {
    const int n = s->n, size = s->count * n;
    const real *half = s->numbers, *slopes = half + size;
    for (int j = 0; j < n; j++) y[j] = R(0.0);
    for (int at = 0; at < size; at += n)
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

/* Along the direction of an actuator the plays begin to move in the order of their widths, and y is
   piecewise linear in u. The pieces ascend, also after rounding: then the one that holds the goal has
   a slope, and the command is within it. */
static inline void hk_plays_command(const hk_stage *s, const real *u, real *plays, real *y,
                                    real *goal) {
    const int n = s->n, size = s->count * n;
    const real *half = s->numbers, *slopes = half + size;
    for (int j = 0; j < n; j++) {
        const real to = goal[j], side = to > y[j] ? R(1.0) : R(-1.0);
        real from = hk_larger(side * plays[j] + half[j], side * u[j]), end = from;
        real level = side * y[j], lag = slopes[j] * half[j], slope = slopes[j];
        int at = j + n;
        for (; at < size; at += n) {
            end = hk_larger(side * plays[at] + half[at], from);
            const real next = level + slope * (end - from);
            if (!(next < side * to)) break;
            from = end, level = next;
            lag += (slopes[at] - slope) * half[at], slope = slopes[at];
        }
        if (to == y[j])
            goal[j] = u[j];
        else if (at < size) {
            const real ahead = from + (side * to - level) / slope;
            goal[j] = side * (ahead < end ? ahead : end);
        } else /* all of them move */
            goal[j] = side * hk_larger(side * to + lag, from);
        y[j] = to;
    }
    for (int at = 0; at < size; at += n)
        for (int j = 0; j < n; j++) {
            const real low = goal[j] - half[at + j], high = goal[j] + half[at + j];
            plays[at + j] = plays[at + j] < low ? low : plays[at + j];
            plays[at + j] = high < plays[at + j] ? high : plays[at + j];
        }
}
