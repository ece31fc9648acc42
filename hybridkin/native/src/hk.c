/* The compiled core: the kernels for one row and for blocks of rows, and what Python calls. */

#include <string.h>

#include "plan.h"

#define HK_ROW_LANES /* one row of a network has lanes over the hidden units */

#include "row.h"
#include "model.h"

#include "lanes.h"
#include "model.h"
#include "ik_step.h"
#include "ik_search.h"

static HK_NOINLINE void ik_model(const ik_settings *ik, const real *q, real *x, real *J) {
    real tip[3], turn[9];
    if (IK_IS_POSE(ik) || IK_IS_AXIS(ik)) {
        hk_pose(&ik->plan, ik->model, q, tip, turn, J, NULL, ik->work);
        ik_pose_of(ik, tip, turn, x);
    } else
        hk_model(&ik->plan, ik->model, q, x, J, NULL, ik->work);
}

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

#ifndef HK_SOURCES
#define HK_SOURCES 0u
#endif
/* A checksum of the sources that this was compiled from. */
HK_API uint32_t hk_sources(void) { return HK_SOURCES; }

/* What every function is called with: a plan, the place of a node in it, and memory to compute in,
   at any address, as long as hk_work says. Calls that run at the same time need their own. */
typedef struct {
    const int32_t *code;
    const real *data;
    int64_t at;
    real *work;
} hk_call;

/* Numbers of memory to compute in. */
HK_API int64_t hk_work(const int32_t *code, int32_t at) {
    const int n = code[HK_MOST_N], S = code[HK_MOST_S], m = code[HK_MOST_M];
    const int model = HK_MODEL_WORK(n, S, m, code[HK_MOST_F]);
    const int of_units = (m + m * n) * HK_LANES; /* see hkr_units */
    int around = n + m + m * n, slots = 0;
    if (code[at + HK_KIND] == HK_IK) {
        around = IK_SEARCH_WORK(n);
        const int32_t *more = code + at + HK_MORE, *body = ik_body_of(code, at);
        const int n_pairs = IK_PAIRS_OF(body, more[IK_N_OBSTACLES]);
        slots = IK_SLOTS_WORK(n, code[at + HK_M], more[IK_N_NORMALS], body[IK_N_POINTS], n_pairs) +
                IK_STATE_SIZE(n, IK_ROWS, IK_WIDTH);
    }
    return (int64_t)HK_LANES * (1 + around + model) + of_units + slots;
}

/* Rows that will be written soon: the cache has their lines then, and the stores need not wait. */
static inline void hk_expect(const real *rows, int count) {
    for (int i = 0; i < count; i += 64 / (int)sizeof(real)) __builtin_prefetch(rows + i, 1);
}

/* At most HK_LANES rows. With `next`, as many follow. */
static void hk_block(const hk_plan *p, int at, V *work, const real *q, int rows, int next, real *x,
                     real *J, real *distance) {
    const int n = p->code[at + HK_N], m = x ? p->code[at + HK_M] : 1;
    V *vq = hkv_take(&work, n), *vx = hkv_take(&work, m), *vJ = hkv_take(&work, m * n), far;
    hkv_from_rows(n, rows, q, vq);
    if (next && x) hk_expect(x + rows * m, rows * m);
    if (next && J) hk_expect(J + rows * m * n, rows * m * n);
    if (x)
        hkv_model(p, at, vq, vx, J ? vJ : NULL, distance ? &far : NULL, work);
    else
        hkv_domain(p, at, vq, &far, J ? vJ : NULL, work);
    if (x) hkv_to_rows(m, rows, vx, x);
    if (J) hkv_to_rows(m * n, rows, vJ, J);
    if (distance) hkv_to_rows(1, rows, &far, distance);
}

/* x (rows, m), J (rows, m, n) and domain distances (rows) of q (rows, n); NULL: no J, no distance.
   Where x is NULL, the distances alone, and their slopes (rows, n) in J. For `enough` see hk_plan. */
HK_API void hk_evaluate(const hk_call *call, const real *q, int64_t rows, real *x, real *J,
                        real *distance, real enough) {
    const hk_plan plan = {call->code, call->data, enough};
    const int at = (int)call->at, n = plan.code[at + HK_N], m = x ? plan.code[at + HK_M] : 1;
    if (rows == 1 && !x)
        hk_domain(&plan, at, q, distance, J, call->work);
    else if (rows == 1)
        hk_model(&plan, at, q, x, J, distance, call->work);
    else
        for (int64_t r = 0; r < rows; r += HK_LANES) {
            /* The last block is a whole one too, with rows that come out the same once more. */
            const int64_t left = rows - r;
            const int64_t from = left < HK_LANES && rows > HK_LANES ? rows - HK_LANES : r;
            const int count = left < HK_LANES ? (int)(rows - from) : HK_LANES;
            hk_block(&plan, at, hkv_aligned(call->work), q + from * n, count, left >= 2 * HK_LANES,
                     x ? x + from * m : NULL, J ? J + from * m * n : NULL,
                     distance ? distance + from : NULL);
        }
}

/* Bytes that a plan was made of, and a copy of what they were then. */
typedef struct {
    const void *now, *then;
    int64_t bytes;
} hk_source;

/* Whether any of them have changed. */
HK_API int32_t hk_changed(const hk_source *source, int64_t count) {
    for (; count > 0; count--, source++)
        if (memcmp(source->now, source->then, (size_t)source->bytes)) return 1;
    return 0;
}

/* What single rows are evaluated with; x (m), J (m, n) and the distance stand in `results`. */
typedef struct {
    hk_call call;
    real *results;
    const hk_source *sources;
    int64_t count;
} hk_row;

/* A row q (n), see hk_evaluate; `asked` says what is computed. With HK_IF_SAME, nothing is where the
   sources have changed, and 1 is returned. */
HK_API int32_t hk_evaluate_row(const hk_row *row, const real *q, int32_t asked, real enough) {
    if (asked & HK_IF_SAME && hk_changed(row->sources, row->count)) return 1;
    const hk_call *call = &row->call;
    const hk_plan plan = {call->code, call->data, enough};
    const int at = (int)call->at, n = call->code[at + HK_N], m = call->code[at + HK_M];
    real *x = row->results, *J = x + m, *distance = J + m * n;
    hk_model(&plan, at, q, x, asked & HK_J ? J : NULL, asked & HK_DISTANCE ? distance : NULL,
             call->work);
    return 0;
}

/* Rows (rows, n) through hysteresis, see hysteresis.h: commands, or with `lead` what the actuators are
   to do, `seconds` (rows) after the row before. At negative ones the state begins anew, without
   hysteresis. The results are what they do, or the commands. */
HK_API void hk_hysteresis_rows(int64_t rows, int32_t n, int32_t lead, real rounding,
                               const int32_t *code, const real *numbers, const real *seconds,
                               const real *given, real *state, real *results) {
    const hk_hysteresis h = {code, numbers, n, rounding};
    const int size = code[HK_STATE_ROWS] * n;
    const real *y = state + size - n;
    for (int64_t r = 0; r < rows; r++, given += n, results += n) {
        const real passed = seconds[r] < R(0.0) ? R(0.0) : seconds[r];
        for (int i = 0; i < size && seconds[r] < R(0.0); i++) state[i] = given[i % n];
        for (int j = 0; j < n; j++) *(lead ? results + j : state + j) = given[j];
        if (lead)
            hk_hysteresis_command(&h, passed, results, state);
        else
            hk_hysteresis_apply(&h, passed, state);
        for (int j = 0; j < n && !lead; j++) results[j] = y[j];
    }
}

/* What follows targets: settings, and the state of `ik_tick`. */
typedef struct {
    hk_call call;
    real *state;
} ik_follower;

static ik_settings ik_settings_in(const hk_call *call) {
    return ik_settings_of(call->code, call->data, (int)call->at, call->work);
}

/* A period, see `ik_tick`. */
HK_API int32_t hk_ik_tick(const ik_follower *f) {
    ik_settings ik = ik_settings_in(&f->call);
    const ik_state now = ik_state_of(&ik, f->state);
    ik.scene = now.scene;
    return ik_tick(&ik, f->state, now.seen);
}

static void ik_put(int64_t row, int width, const real *rows, real *to) {
    for (int i = 0; rows && i < width; i++) to[i] = rows[width * row + i];
}

/* Single ticks for rows of q (rows, n), targets, and with the mode their motions (rows, m) and
   measured tips; `last` (rows, n) are the steps before. `out` (rows, n + width + 3) holds dq, x,
   |e|, sigma_min, damping; held (rows, n). */
HK_API void hk_ik_steps(const hk_call *call, int64_t rows, int32_t mode, const real *q,
                        const real *target, const real *feed, const real *tip, const real *last,
                        real *out, unsigned char *held) {
    ik_settings ik = ik_settings_in(call);
    const int n = ik.n, width = ik.width;
    real *state = ik.work;
    ik.work += IK_STATE_SIZE(n, ik.m, width);
    const ik_state now = ik_state_of(&ik, state);
    for (int i = 0; i < IK_STATE_SIZE(n, ik.m, width); i++) state[i] = R(0.0);
    state[IK_MODE] = mode;
    state[IK_PERIOD] = ik.dt;
    for (int64_t r = 0; r < rows; r++, out += n + width + 3) {
        ik_put(r, width, target, now.target);
        ik_put(r, ik.m, feed, now.feed);
        ik_put(r, width, tip, now.tip);
        ik_put(r, n, q, now.q);
        for (int j = 0; j < n; j++) now.dq[j] = last ? last[n * r + j] : R(0.0);
        ik_tick(&ik, state, NULL);
        for (int j = 0; j < n; j++) {
            out[j] = now.dq[j];
            held[n * r + j] = now.held[j] > R(0.0);
        }
        for (int i = 0; i < width; i++) out[n + i] = now.x[i];
        out[n + width] = state[IK_DISTANCE];
        out[n + width + 1] = state[IK_SIGMA_MIN];
        out[n + width + 2] = state[IK_DAMPING];
    }
}

/* The task at rows q (rows, n): x (rows, width) and J (rows, m, n). */
HK_API void hk_ik_look(const hk_call *call, int64_t rows, const real *q, real *x, real *J) {
    const ik_settings ik = ik_settings_in(call);
    ik_look_at(&ik, rows, q, x, J);
}

/* The search, see ik_search.h; with tolerances of the whole error (parts = 0), or of its parts. */
HK_API void hk_ik_find(const hk_call *call, int64_t rows, int32_t mode, int32_t max_iter,
                       int32_t parts, const real *tol, const real *target, real *q, real *J,
                       real *e, int32_t *found, int32_t *n_iter) {
    ik_search_t search = {ik_settings_in(call), mode, max_iter, parts, tol};
    ik_search(&search, rows, target, q, J, e, found, n_iter);
}
