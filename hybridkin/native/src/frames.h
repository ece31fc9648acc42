/* The frames along a chain of arcs, and how arcs move and turn what follows them. */

/* What is needed of segment k: the frame before it, vectors of the frame after it, and in the frame
   before it how the end of its arc moves and turns by its length and bendings. */
typedef struct {
    V before[9]; /* axes of the frame before the segment, in the base frame */
    V vectors[6]
             [3]; /* axes of the frame after it, then these x d, d the lever to the robot's end */
    V arc_end[3], end[3]; /* end of the arc, and with its rigid offset */
    V moves[3][3], spins[3][3];
} HK(posed);

#define HK_POSED (int)(sizeof(HK(posed)) / sizeof(V)) /* numbers of it */

static inline void HK(cross)(const V *a, const V *b, V *c) {
    for (int i = 0; i < 3; i++)
        c[i] = a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3];
}

/* Follow one arc with a rigid offset from the frame `axes`, `at`, which become those after it. */
static inline void HK(follow)(V length, V bx, V by, real offset, V axes[3][3], V *at,
                              HK(posed) * s) {
    const HK(stumpff_t) a = HK(stumpff)(bx * bx + by * by);
    const V slope_f = (a.c3 - a.g) * length, slope_g = (a.c4 + a.c4 - a.c3) * length;
    const V zero = SPLAT(0.0), one = SPLAT(1.0), gl = a.g * length, across = slope_g * bx * by;
    const V local[3][3] = {{one - a.g * bx * bx, -(a.g * bx * by), -(a.f * bx)},
                           {-(a.g * bx * by), one - a.g * by * by, -(a.f * by)},
                           {a.f * bx, a.f * by, a.c}};
    const V moves[3][3] = {{a.g * bx, a.g * by, a.f},
                           {gl + slope_g * bx * bx, across, slope_f * bx},
                           {across, gl + slope_g * by * by, slope_f * by}};
    const V spins[3][3] = {{zero, zero, zero},
                           {-(a.c3 * bx * by), one - a.c3 * by * by, -(a.g * by)},
                           {a.c3 * bx * bx - one, a.c3 * bx * by, a.g * bx}};
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            s->before[3 * i + j] = axes[i][j];
            s->moves[i][j] = moves[i][j];
            s->spins[i][j] = spins[i][j];
        }
    for (int j = 0; j < 3; j++) {
        const V x = axes[0][j], y = axes[1][j], z = axes[2][j];
        for (int i = 0; i < 3; i++)
            axes[i][j] = x * local[i][0] + y * local[i][1] + z * local[i][2];
        s->arc_end[j] = at[j] + (x * moves[0][0] + y * moves[0][1] + z * moves[0][2]) * length;
        s->end[j] = at[j] = s->arc_end[j] + axes[2][j] * offset;
    }
}
