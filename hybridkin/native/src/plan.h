/* A plan: what the kernels compute, as one array of numbers and one of positions in it. */

#ifndef HK_PLAN_H
#define HK_PLAN_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>

#ifdef HK_FLOAT
typedef float real;
typedef int32_t hk_bits;
#define HK_MATH(name) name##f
#define HK_EPS 1.1920929e-7f
#define HK_TINY 1.17549435e-38f
#else
typedef double real;
typedef int64_t hk_bits;
#define HK_MATH(name) name
#define HK_EPS 2.220446049250313e-16
#define HK_TINY 2.2250738585072014e-308
#endif
#define R(c) ((real)(c))

/* Code exported for one model sets HK_KINDS, one bit per kind of its nodes, its own sizes, and
   whether its task is a pose (HK_POSES) or has half-spaces (HK_SPACES), its body keeps clear of
   obstacles (HK_OBSTACLES), or its actuators have hysteresis (HK_HYSTERESIS). */
#ifdef HK_KINDS
#define HK_USES(kind) ((HK_KINDS >> (kind)) % 2u)
#define HK_IS_ONLY_CHAIN(kind) ((HK_KINDS & 30u) == 1u << (kind)) /* of the first four kinds */
#define HK_COMMON(sizes) 0
#define HK_INLINE static inline
#define HK_NOINLINE
#else
#define HK_USES(kind) 1
#define HK_IS_ONLY_CHAIN(kind) 0
#define HK_POSES 1 /* of a task */
#define HK_SPACES 1
#define HK_OBSTACLES 1
#define HK_HYSTERESIS 1
#define HK_COMMON(sizes) (sizes) /* have instances of their own, which keep all in registers */
#define HK_INLINE static inline __attribute__((always_inline))
#define HK_NOINLINE __attribute__((noinline))
#endif
#if defined(__GNUC__) && !defined(__clang__) && !defined(HK_KINDS) /* clang does so by itself */
#define HK_UNROLLED _Pragma("GCC unroll 9")
#else
#define HK_UNROLLED
#endif
#include "kinds.h"
#define HK_MOST_Z(n, S) (3 * (S) > (n) ? 3 * (S) : (n)) /* inner coordinates */

/* A plan begins with its largest sizes. */
enum { HK_MOST_N, HK_MOST_S, HK_MOST_M, HK_MOST_F, HK_MOST_R };

/* A node of a plan: code[at] is its kind, then the lengths of its input and output, where its
   numbers begin in `data`, and what else its kind needs: sizes, and where its parts stand. */
enum { HK_KIND, HK_N, HK_M, HK_DATA, HK_MORE };

/* Whether the node at a place, or the chain, is of a kind. */
#define HK_IS(p, at, kind) (HK_USES(kind) && (p)->code[at] == (kind))
#define HK_CHAIN_IS(p, at, kind) (HK_IS_ONLY_CHAIN(kind) || HK_IS(p, at, kind))

/* A hybrid adds the places of mechanical model, drift and distance from other groups, the number of
   corrections, and of each whether it acts inside, its regressor and its guard; -1 stands for none.
 */
enum { HK_BASE, HK_DRIFT, HK_TESTED, HK_COUNT, HK_FIRST };
enum { HK_INNER, HK_REGRESSOR, HK_GUARD, HK_STRIDE };

typedef struct {
    const int32_t *code;
    const real *data;
    real enough; /* an upper bound of a domain distance is as good as the distance up to here */
} hk_plan;

/* A leverage: with v = phi - center and r = R' v it is |r|^2 + offset, or with a prior
   prior |v|^2 - |r|^2 + offset. R has its columns (k) one after the other, f numbers each. */
typedef struct {
    int f, k, full; /* not full: R is upper triangular */
    real offset, prior;
    const real *center, *R;
} hk_factor;

static inline const real *hk_numbers(const hk_plan *p, int at) {
    return p->data + p->code[at + HK_DATA];
}

#endif
