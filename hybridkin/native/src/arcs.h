/* Chains of circular arcs. Arcs are lengths of all segments, then their x-, then y-bendings. */

#define HK_FRAME 13 /* numbers of a frame before its offsets */

typedef struct {
    V c, f, g, c3, c4;
} HK(stumpff_t);

/* Entire functions of s = theta^2: polynomials up to a half turn, to rounding as good as the power
   series (interpolated where Chebyshev polynomials vanish); trigonometry beyond. */
static inline HK(stumpff_t) HK(stumpff)(V s) {
    const M bent = s > SPLAT(9.869604401089358);
    HK(stumpff_t) a;
    a.c3 = SPLAT(-1.775165055612406e-20);
    a.c4 = SPLAT(-8.135186188193454e-22);
    a.c3 = a.c3 * s + R(8.183034366062202e-18);
    a.c4 = a.c4 * s + R(4.094574861070063e-19);
    a.c3 = a.c3 * s - R(2.811024030605762e-15);
    a.c4 = a.c4 * s - R(1.5617392046473866e-16);
    a.c3 = a.c3 * s + R(7.647133470817639e-13);
    a.c4 = a.c4 * s + R(4.7794646505496603e-14);
    a.c3 = a.c3 * s - R(1.6059042526461696e-10);
    a.c4 = a.c4 * s - R(1.1470745048458593e-11);
    a.c3 = a.c3 * s + R(2.5052108350866163e-08);
    a.c4 = a.c4 * s + R(2.0876756973372715e-09);
    a.c3 = a.c3 * s - R(2.755731922346156e-06);
    a.c4 = a.c4 * s - R(2.7557319223766046e-07);
    a.c3 = a.c3 * s + R(0.00019841269841265803);
    a.c4 = a.c4 * s + R(2.4801587301585607e-05);
    a.c3 = a.c3 * s - R(0.008333333333333321);
    a.c4 = a.c4 * s - R(0.0013888888888888883);
    a.c3 = a.c3 * s + R(0.16666666666666666);
    a.c4 = a.c4 * s + R(0.041666666666666664);
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
   `frame` holds the rotation of the base (3, 3), its position (3), the robot's reach and the rigid
   offsets (S). */
HK_INLINE void HK(arcs_tip_of)(int S, const real *frame, const V *restrict z, V *restrict x,
                               V *restrict C) {
    const real *turn = frame, *origin = frame + 9, *offsets = frame + HK_FRAME;
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
    switch (HK_COMMON(S)) { /* loops of known length keep all in registers */
    case 1: HK(arcs_tip_of)(1, frame, z, x, C); break;
    case 2: HK(arcs_tip_of)(2, frame, z, x, C); break;
    case 3: HK(arcs_tip_of)(3, frame, z, x, C); break;
    default: HK(arcs_tip_of)(S, frame, z, x, C);
    }
}

/* Arcs that follow from actuators linearly: segment k from `width` of them, from k `step` on. The
   matrix (S, 3, width) and the arcs of q = 0 (S, 3). */
typedef struct {
    int S, step, width;
    const real *matrix, *zero;
} HK(linear_arcs);

/* The arcs z (3 S) of q. */
HK_INLINE void HK(arcs_of)(HK(linear_arcs) a, const V *q, V *z) {
    for (int k = 0; k < a.S; k++)
        for (int part = 0; part < 3; part++) {
            const real *row = a.matrix + (3 * k + part) * a.width;
            V sum = SPLAT(a.zero[3 * k + part]);
            for (int j = 0; j < a.width; j++) sum = sum + q[k * a.step + j] * row[j];
            z[part * a.S + k] = sum;
        }
}

/* J (rows, n) += C dz/dq, for C (rows, 3 S). */
HK_INLINE void HK(pull_arcs)(HK(linear_arcs) a, int rows, int n, const V *C, V *J) {
    for (int i = 0; i < rows; i++, J += n, C += 3 * a.S)
        for (int k = 0; k < a.S; k++) {
            const real *row = a.matrix + 3 * k * a.width;
            for (int j = 0; j < a.width; j++)
                J[k * a.step + j] = J[k * a.step + j] + C[k] * row[j] +
                                    C[a.S + k] * row[a.width + j] +
                                    C[2 * a.S + k] * row[2 * a.width + j];
        }
}
