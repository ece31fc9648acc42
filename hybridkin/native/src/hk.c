/* The compiled core: the kernels for one row and for blocks of rows, and what Python calls. */

#include "plan.h"

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

/* x (rows, m), J (rows, m, n) and domain distances (rows) of q (rows, n); NULL is left out. */
HK_API void hk_evaluate(const int32_t *code, const real *data, int32_t at, const real *q,
                        int64_t rows, real *x, real *J, real *distance) {
    const hk_plan plan = {code, data};
    const int n = code[at + HK_N], m = code[at + HK_M];
    if (rows == 1) {
        real own_x[HK_MAX_M];
        hk_model(&plan, at, q, x ? x : own_x, J, distance);
        return;
    }
    for (int64_t r = 0; r < rows; r += HK_LANES) {
        V vq[HK_MAX_N], vx[HK_MAX_M], vJ[HK_MAX_M * HK_MAX_N], far;
        const int here = (int)(rows - r < HK_LANES ? rows - r : HK_LANES);
        EACH(i) for (int j = 0; j < n; j++) vq[j][i] = q[(r + (i < here ? i : here - 1)) * n + j];
        hkv_model(&plan, at, vq, vx, J ? vJ : NULL, distance ? &far : NULL);
        for (int i = 0; i < here; i++) {
            if (x)
                for (int j = 0; j < m; j++) x[(r + i) * m + j] = vx[j][i];
            if (J)
                for (int j = 0; j < m * n; j++) J[(r + i) * m * n + j] = vJ[j][i];
            if (distance) distance[r + i] = far[i];
        }
    }
}
