/* What the library is measured against: one hybrid and nothing else, by hand, for AVX-512. Tip and
   Jacobian of three segments with three chambers each, base and tool at their origins, and of an
   error model of 100 logistic units; or of this chain alone.

   Rows stand in lanes, 16 at a time in two registers, so that each number that is loaded serves two
   products. The numbers of the robot are in numbers.h: what can be multiplied out before, is.
   The polynomials hold up to a half turn of a segment, for which its chambers are too short. */

#include <immintrin.h>
#include <string.h>

#include "numbers.h"

typedef __m512d V;
#define ALWAYS static inline __attribute__((always_inline))
#define EACH(i, n) _Pragma("GCC unroll 32") for (int i = 0; i < (n); i++)

enum { UNITS = 100, AT_ONCE = 5 };

ALWAYS V all(double c) { return _mm512_set1_pd(c); }
ALWAYS V madd(V a, V b, V c) { return _mm512_fmadd_pd(a, b, c); }

/* 2^r up to |r| = 1/2, minimax; from the highest power on, as the next ones. */
static const double EXP2[11] = {7.072585949269223e-09,
                                1.0208690299958306e-07,
                                1.321544258792169e-06,
                                1.5252657260200837e-05,
                                0.0001540353044173605,
                                0.0013333558230164974,
                                0.009618129107606888,
                                0.05550410866444772,
                                0.24022650695910097,
                                0.69314718055995,
                                1.0};

/* (1 - sin t / t) / t^2 by t^2, up to a half turn. */
static const double C3[10] = {
    -1.775165055612406e-20,  8.183034366062202e-18,  -2.811024030605762e-15, 7.647133470817639e-13,
    -1.6059042526461696e-10, 2.5052108350866163e-08, -2.755731922346156e-06, 0.00019841269841265803,
    -0.008333333333333321,   0.16666666666666666};

/* (1/2 - (1 - cos t) / t^2) / t^2 likewise. */
static const double C4[10] = {-8.135186188193454e-22,  4.094574861070063e-19,
                              -1.5617392046473866e-16, 4.7794646505496603e-14,
                              -1.1470745048458593e-11, 2.0876756973372715e-09,
                              -2.7557319223766046e-07, 2.4801587301585607e-05,
                              -0.0013888888888888883,  0.041666666666666664};

/* 2^t */
ALWAYS V power_of_two(V t) {
    const V k = _mm512_roundscale_pd(t, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC), r = t - k;
    V y = all(EXP2[0]);
    EACH(i, 10) y = madd(y, r, all(EXP2[i + 1]));
    return _mm512_scalef_pd(y, k);
}

ALWAYS void transpose(V a[8]) {
    V b[8], c[8];
    EACH(i, 4) {
        b[2 * i] = _mm512_unpacklo_pd(a[2 * i], a[2 * i + 1]);
        b[2 * i + 1] = _mm512_unpackhi_pd(a[2 * i], a[2 * i + 1]);
    }
    EACH(i, 2)
        EACH(k, 2) {
            c[4 * i + k] = _mm512_shuffle_f64x2(b[4 * i + k], b[4 * i + 2 + k], 0x88);
            c[4 * i + 2 + k] = _mm512_shuffle_f64x2(b[4 * i + k], b[4 * i + 2 + k], 0xdd);
        }
    EACH(k, 4) {
        a[k] = _mm512_shuffle_f64x2(c[k], c[4 + k], 0x88);
        a[4 + k] = _mm512_shuffle_f64x2(c[k], c[4 + k], 0xdd);
    }
}

/* Rows (8, 9) into lanes. */
ALWAYS void rows_in(const double *q, V *u) {
    EACH(i, 8) u[i] = _mm512_loadu_pd(q + 9 * i);
    transpose(u);
    u[8] = _mm512_set_pd(q[71], q[62], q[53], q[44], q[35], q[26], q[17], q[8]);
}

/* Lanes (27 and 3) into rows; the last eight columns of J overlap the ones before. */
ALWAYS void rows_out(const V *lanes_x, const V *lanes_J, double *x, double *J) {
    const __mmask8 three = 7;
    V a[8];
    EACH(part, 4) {
        const int at = part < 3 ? 8 * part : 19;
        EACH(i, 8) a[i] = lanes_J[at + i];
        transpose(a);
        EACH(i, 8) _mm512_storeu_pd(J + 27 * i + at, a[i]);
    }
    EACH(i, 3) a[i] = lanes_x[i];
    EACH(i, 5) a[3 + i] = a[2];
    transpose(a);
    EACH(i, 8) _mm512_mask_storeu_pd(x + 3 * i, three, a[i]);
}

/* x and J of the chain, entire functions of theta^2 up to a half turn. */
ALWAYS void chain(const V *q, V *x, V *J) {
    V c[3], f[3], g[3], c3[3], c4[3], bx[3], by[3], across[3], rest[3], tail[3][3], C[3][9];
    V p[3] = {all(0.0), all(0.0), all(0.0)};
    for (int k = 2; k >= 0; k--) {
        const double *to = ARCS + 9 * k;
        const V *own = q + 3 * k;
        const V length = own[0] * to[0] + own[1] * to[1] + own[2] * to[2];
        bx[k] = own[0] * to[3] + own[1] * to[4] + own[2] * to[5];
        by[k] = own[0] * to[6] + own[1] * to[7] + own[2] * to[8];
        const V s = bx[k] * bx[k] + by[k] * by[k];
        c3[k] = all(C3[0]);
        c4[k] = all(C4[0]);
        EACH(i, 9) {
            c3[k] = madd(c3[k], s, all(C3[i + 1]));
            c4[k] = madd(c4[k], s, all(C4[i + 1]));
        }
        f[k] = 1.0 - s * c3[k];
        g[k] = 0.5 - s * c4[k];
        c[k] = 1.0 - s * g[k];
        EACH(i, 3) tail[k][i] = p[i];
        rest[k] = length - bx[k] * p[0] - by[k] * p[1];
        across[k] = g[k] * rest[k] + f[k] * p[2];
        p[0] += bx[k] * across[k];
        p[1] += by[k] * across[k];
        p[2] = f[k] * rest[k] + c[k] * p[2];
    }
    EACH(i, 3) x[i] = p[i];
    for (int k = 2; k >= 0; k--) {
        const V slope_f = c3[k] - g[k], slope_g = c4[k] + c4[k] - c3[k];
        const V to = slope_g * rest[k] + slope_f * tail[k][2];
        const V n = slope_f * rest[k] - f[k] * tail[k][2];
        const V to_x = to * bx[k] - g[k] * tail[k][0], to_y = to * by[k] - g[k] * tail[k][1];
        C[0][3 * k] = g[k] * bx[k];
        C[1][3 * k] = g[k] * by[k];
        C[2][3 * k] = f[k];
        C[0][3 * k + 1] = across[k] + bx[k] * to_x;
        C[1][3 * k + 1] = by[k] * to_x;
        C[2][3 * k + 1] = n * bx[k] - f[k] * tail[k][0];
        C[0][3 * k + 2] = bx[k] * to_y;
        C[1][3 * k + 2] = across[k] + by[k] * to_y;
        C[2][3 * k + 2] = n * by[k] - f[k] * tail[k][1];
        for (int j = 3 * k + 3; j < 9; j++) {
            const V along = bx[k] * C[0][j] + by[k] * C[1][j], w = f[k] * C[2][j] - g[k] * along;
            C[0][j] += bx[k] * w;
            C[1][j] += by[k] * w;
            C[2][j] = c[k] * C[2][j] - f[k] * along;
        }
    }
    EACH(i, 3)
        for (int k = 0; k < 3; k++)
            EACH(j, 3) {
                const double *to = ARCS + 9 * k + j;
                J[9 * i + 3 * k + j] =
                    C[i][3 * k] * to[0] + C[i][3 * k + 1] * to[3] + C[i][3 * k + 2] * to[6];
            }
}

/* Features of 16 rows and their derivatives by what enters the units, whose weights are such that
   the exponential is one of 2. */
ALWAYS void units(const V (*q)[9], V (*s)[2], V (*d)[2]) {
    for (int h = 0; h < UNITS; h += AT_ONCE) {
        V t[AT_ONCE][2];
        EACH(i, AT_ONCE)
            EACH(r, 2) t[i][r] = all(BIAS[h + i]);
        EACH(j, 9)
            EACH(i, AT_ONCE) {
                const V w = all(WEIGHTS[9 * (h + i) + j]);
                EACH(r, 2) t[i][r] = madd(q[r][j], w, t[i][r]);
            }
        EACH(i, AT_ONCE)
            EACH(r, 2) {
                s[h + i][r] = 1.0 / (1.0 + power_of_two(t[i][r]));
                d[h + i][r] = s[h + i][r] - s[h + i][r] * s[h + i][r];
            }
    }
}

/* Adds COUNT sums of the features, weighted, from the first on. */
#define SUMS(features, weights, width, first, COUNT, to)                                           \
    do {                                                                                           \
        V sum[COUNT][2];                                                                           \
        EACH(k, COUNT)                                                                             \
            EACH(r, 2) sum[k][r] = to[r][(first) + k];                                             \
        for (int h = 0; h < UNITS; h++) {                                                          \
            const V one = features[h][0], two = features[h][1];                                    \
            EACH(k, COUNT) {                                                                       \
                const V w = all(weights[(width) * h + (first) + k]);                               \
                sum[k][0] = madd(one, w, sum[k][0]);                                               \
                sum[k][1] = madd(two, w, sum[k][1]);                                               \
            }                                                                                      \
        }                                                                                          \
        EACH(k, COUNT)                                                                             \
            EACH(r, 2) to[r][(first) + k] = sum[k][r];                                             \
    } while (0)

static void block(const double *rows, double *to_x, double *to_J, int hybrid) {
    V q[2][9], x[2][3], J[2][27], s[UNITS][2], d[UNITS][2];
    EACH(r, 2) rows_in(rows + 72 * r, q[r]);
    for (int i = 0; i < 432; i += 8) __builtin_prefetch(to_J + 432 + i, 1);
    for (int i = 0; i < 48; i += 8) __builtin_prefetch(to_x + 48 + i, 1);
    for (int r = 0; r < 2; r++) chain(q[r], x[r], J[r]);
    if (hybrid) {
        units((const V(*)[9])q, s, d);
        EACH(r, 2)
            EACH(i, 3) x[r][i] += all(INTERCEPT[i]);
        SUMS(s, OUT, 3, 0, 3, x);
        SUMS(d, SLOPES, 27, 0, 14, J);
        SUMS(d, SLOPES, 27, 14, 13, J);
    }
    EACH(r, 2) rows_out(x[r], J[r], to_x + 24 * r, to_J + 216 * r);
}

static void evaluate(const double *q, long rows, double *x, double *J, int hybrid) {
    for (; rows >= 16; rows -= 16, q += 144, x += 48, J += 432) block(q, x, J, hybrid);
    if (rows == 0) return;
    double last_q[144] = {0.0}, last_x[48], last_J[432];
    memcpy(last_q, q, 9 * rows * sizeof *q);
    block(last_q, last_x, last_J, hybrid);
    memcpy(x, last_x, 3 * rows * sizeof *x);
    memcpy(J, last_J, 27 * rows * sizeof *J);
}

void limit_hybrid(const double *q, long rows, double *x, double *J) { evaluate(q, rows, x, J, 1); }
void limit_chain(const double *q, long rows, double *x, double *J) { evaluate(q, rows, x, J, 0); }
