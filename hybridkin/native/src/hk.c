/* The compiled core: the kernels for one row and for blocks of rows, and what Python calls. */

#include "plan.h"
#include "play.h"

#define HK_ROW_LANES /* one row of a network has lanes over the hidden units */

#define HK_LANES 1
#include "model.h"
#undef HK_LANES

#if defined(__AVX512F__)
#define HK_LANES 8
#elif defined(__AVX__)
#define HK_LANES 4
#else
#define HK_LANES 2
#endif
#include "model.h"

#if defined(_WIN32)
#define HK_API __declspec(dllexport)
#else
#define HK_API __attribute__((visibility("default")))
#endif

#if defined(__x86_64__)
#include <cpuid.h>

/* 2, 3 or 4: the best variant that processor and system can run. (__builtin_cpu_supports would
   say it, but is empty in the libraries of zig.) */
HK_API int32_t hk_level(void) {
    const unsigned avx512 = bit_AVX512F | bit_AVX512CD | bit_AVX512BW | bit_AVX512DQ | bit_AVX512VL;
    unsigned a, b, c, d, kept;
    if (!__get_cpuid(1, &a, &b, &c, &d) || !(c & bit_OSXSAVE) || !(c & bit_FMA)) return 2;
    __asm__("xgetbv" : "=a"(kept), "=d"(d) : "c"(0)); /* the registers that the system keeps */
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || !(b & bit_AVX2) || (kept & 0x06) != 0x06)
        return 2;
    return (b & avx512) == avx512 && (kept & 0xe6) == 0xe6 ? 4 : 3;
}
#else
HK_API int32_t hk_level(void) { return 0; }
#endif

/* A sum over the sources that this was compiled from. */
HK_API uint32_t hk_sources(void) { return HK_SOURCES; }

static void hk_block(const hk_plan *p, int at, const real *q, int rows, real *x, real *J,
                     real *distance) {
    V vq[HK_MAX_N], vx[HK_MAX_M], vJ[HK_MAX_M * HK_MAX_N], far;
    const int n = p->code[at + HK_N], m = x ? p->code[at + HK_M] : 1;
    EACH(i) for (int j = 0; j < n; j++) vq[j][i] = q[(i < rows ? i : rows - 1) * n + j];
    if (x)
        hkv_model(p, at, vq, vx, J ? vJ : NULL, distance ? &far : NULL);
    else
        hkv_domain(p, at, vq, &far, J ? vJ : NULL);
    for (int i = 0; i < rows; i++) {
        for (int j = 0; x && j < m; j++) x[i * m + j] = vx[j][i];
        for (int j = 0; J && j < m * n; j++) J[i * m * n + j] = vJ[j][i];
        if (distance) distance[i] = far[i];
    }
}

/* x (rows, m), J (rows, m, n) and domain distances (rows) of q (rows, n); NULL: no J, no distance.
   Where x is NULL, the distances alone, and their slopes (rows, n) in J. */
HK_API void hk_evaluate(const int32_t *code, const real *data, int32_t at, const real *q,
                        int64_t rows, real *x, real *J, real *distance) {
    const hk_plan plan = {code, data};
    const int n = code[at + HK_N], m = x ? code[at + HK_M] : 1;
    if (rows == 1 && !x)
        hk_domain(&plan, at, q, distance, J);
    else if (rows == 1)
        hk_model(&plan, at, q, x, J, distance);
    else
        for (int64_t r = 0; r < rows; r += HK_LANES)
            hk_block(&plan, at, q + r * n, (int)(rows - r < HK_LANES ? rows - r : HK_LANES),
                     x ? x + r * m : NULL, J ? J + r * m * n : NULL, distance ? distance + r : NULL);
}

/* Rows through the play of tendons, see play.h. */
HK_API void hk_play(int64_t rows, int32_t n, int32_t lead, const real *half, const real *given,
                    real *command, real *effective, real *found) {
    hk_play_rows(rows, n, lead, half, given, command, effective, found);
}
