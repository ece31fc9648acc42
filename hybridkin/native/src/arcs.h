/* Chains of circular arcs. Arcs are the lengths of all segments, then the x-, then the y-bendings. */

typedef struct {
    V c, f, g, c3, c4;
} HK(stumpff_t);

/* Entire functions of s = theta^2: a power series up to 1 rad, trigonometry beyond. */
static inline HK(stumpff_t) HK(stumpff)(V s) {
    const M bent = s > SPLAT(1.0);
    HK(stumpff_t) a;
    a.c3 = SPLAT(-1.0 / 355687428096000.0);
    a.c4 = SPLAT(-1.0 / 6402373705728000.0);
    a.c3 = a.c3 * s + R(1.0 / 1307674368000.0);
    a.c4 = a.c4 * s + R(1.0 / 20922789888000.0);
    a.c3 = a.c3 * s - R(1.0 / 6227020800.0);
    a.c4 = a.c4 * s - R(1.0 / 87178291200.0);
    a.c3 = a.c3 * s + R(1.0 / 39916800.0);
    a.c4 = a.c4 * s + R(1.0 / 479001600.0);
    a.c3 = a.c3 * s - R(1.0 / 362880.0);
    a.c4 = a.c4 * s - R(1.0 / 3628800.0);
    a.c3 = a.c3 * s + R(1.0 / 5040.0);
    a.c4 = a.c4 * s + R(1.0 / 40320.0);
    a.c3 = a.c3 * s - R(1.0 / 120.0);
    a.c4 = a.c4 * s - R(1.0 / 720.0);
    a.c3 = a.c3 * s + R(1.0 / 6.0);
    a.c4 = a.c4 * s + R(1.0 / 24.0);
    V cosine = SPLAT(0.0);
    if (HK(any)(bent)) {
        const V far = SELECT(bent, s, SPLAT(1.0)), theta = HK(sqrt)(far);
        V sine;
        HK(sincos)(theta, &sine, &cosine);
        a.c3 = SELECT(bent, (R(1.0) - sine / theta) / far, a.c3);
        a.c4 = SELECT(bent, (R(0.5) - (R(1.0) - cosine) / far) / far, a.c4);
    }
    a.f = R(1.0) - s * a.c3;
    a.g = R(0.5) - s * a.c4;
    a.c = SELECT(bent, cosine, R(1.0) - s * a.g);
    return a;
}

/* The tip x (3) of arcs z (3 S) in the measuring frame, and its derivative C (3, 3 S) if asked for.
   `frame` holds the rotation of the base (3, 3), its position (3) and the rigid offsets (S). */
static inline __attribute__((always_inline)) void HK(arcs_tip_of)(
    int S, const real *frame, const V *z, V *x, V *C) {
    const real *turn = frame, *origin = frame + 9, *offsets = frame + 12;
    HK(stumpff_t) arc[HK_MAX_S];
    V across[HK_MAX_S], rest[HK_MAX_S], tail[HK_MAX_S][3];
    V p[3] = {SPLAT(0.0), SPLAT(0.0), SPLAT(0.0)};
    /* From the last segment to the first: the tail in the end frame, then in the start frame. */
    for (int k = S - 1; k >= 0; k--) {
        const V bx = z[S + k], by = z[2 * S + k];
        arc[k] = HK(stumpff)(bx * bx + by * by);
        p[2] = p[2] + offsets[k];
        for (int i = 0; i < 3; i++) tail[k][i] = p[i];
        rest[k] = z[k] - bx * p[0] - by * p[1];
        across[k] = arc[k].g * rest[k] + arc[k].f * p[2];
        p[0] = p[0] + bx * across[k];
        p[1] = p[1] + by * across[k];
        p[2] = arc[k].f * rest[k] + arc[k].c * p[2];
    }
    for (int i = 0; i < 3; i++)
        x[i] = p[0] * turn[3 * i] + p[1] * turn[3 * i + 1] + p[2] * turn[3 * i + 2] + origin[i];
    if (!C) return;
    for (int k = S - 1; k >= 0; k--) {
        const V bx = z[S + k], by = z[2 * S + k], f = arc[k].f, g = arc[k].g;
        const V slope_f = arc[k].c3 - g, slope_g = arc[k].c4 + arc[k].c4 - arc[k].c3;
        const V to = slope_g * rest[k] + slope_f * tail[k][2];
        const V n = slope_f * rest[k] - f * tail[k][2], m = across[k];
        const V to_x = to * bx - g * tail[k][0], to_y = to * by - g * tail[k][1];
        const V own[3][3] = {
            {g * bx, g * by, f},
            {m + bx * to_x, by * to_x, n * bx - f * tail[k][0]},
            {bx * to_y, m + by * to_y, n * by - f * tail[k][1]},
        };
        for (int part = 0; part < 3; part++)
            for (int i = 0; i < 3; i++) C[(3 * i + part) * S + k] = own[part][i];
        /* The columns of later segments, turned into this segment's start frame. */
        for (int later = k + 1; later < S; later++)
            for (int part = 0; part < 3; part++) {
                V *at = C + part * S + later;
                const V vx = at[0], vy = at[3 * S], vz = at[6 * S];
                const V along = bx * vx + by * vy, w = f * vz - g * along;
                at[0] = vx + bx * w;
                at[3 * S] = vy + by * w;
                at[6 * S] = arc[k].c * vz - f * along;
            }
    }
    for (int j = 0; j < 3 * S; j++) {
        const V a = C[j], b = C[3 * S + j], c = C[6 * S + j];
        for (int i = 0; i < 3; i++)
            C[3 * S * i + j] = a * turn[3 * i] + b * turn[3 * i + 1] + c * turn[3 * i + 2];
    }
}

static inline void HK(arcs_tip)(int S, const real *frame, const V *z, V *x, V *C) {
    switch (S) { /* loops of known length keep all in registers */
    case 1: HK(arcs_tip_of)(1, frame, z, x, C); break;
    case 2: HK(arcs_tip_of)(2, frame, z, x, C); break;
    case 3: HK(arcs_tip_of)(3, frame, z, x, C); break;
    default: HK(arcs_tip_of)(S, frame, z, x, C);
    }
}
