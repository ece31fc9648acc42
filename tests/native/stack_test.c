/* Prints how many bytes of stack every function takes, one "name bytes" a line.

   The functions run in threads whose stack was painted before. With EXPORTED these are those of an
   export named "robot"; else of a library, the first argument, on a plan from a file, the second,
   as for kernels_test.c (q: NaN among them). Functions of steps for a plan of inverse kinematics.
 */

#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { SIZE = 1 << 21, PAINT = 0xa5 };

static size_t painted_over(void *(*run)(void *), void *argument) {
    unsigned char *stack;
    pthread_attr_t attributes;
    pthread_t thread;
    size_t left = 0;
    if (posix_memalign((void **)&stack, 4096, SIZE)) exit(3);
    memset(stack, PAINT, SIZE);
    pthread_attr_init(&attributes);
    if (pthread_attr_setstack(&attributes, stack, SIZE)) exit(3);
    if (pthread_create(&thread, &attributes, run, argument)) exit(3);
    pthread_join(thread, NULL);
    while (left < SIZE && stack[left] == PAINT) left++;
    free(stack);
    return SIZE - left;
}

static void *nothing(void *argument) { return argument; }

static void report(const char *name, void *(*run)(void *), void *argument) {
    printf("%s %zu\n", name, painted_over(run, argument) - painted_over(nothing, NULL));
}

#ifdef EXPORTED

#include "robot.h"

static robot_real x[ROBOT_OUTPUTS], J[ROBOT_OUTPUTS * ROBOT_N], far[ROBOT_N];

static void *forward(void *q) { return robot_forward(q, x), NULL; }
static void *jacobian(void *q) { return robot_jacobian(q, x, J), NULL; }
static void *domain(void *q) { return robot_domain(q) > 0 ? q : NULL; }
#ifdef STEPS
static void *step(void *q) {
    robot_state state;
    robot_reset(&state, q);
    robot_step(&state, far, x, x);
    robot_step(&state, x, NULL, NULL);
    return NULL;
}
#endif

int main(void) {
    for (int j = 0; j < ROBOT_N; j++) far[j] = 3 * robot_home[j] + 1;
    report("forward", forward, far);
    report("jacobian", jacobian, far);
    report("domain", domain, far);
#ifdef STEPS
    report("step", step, (void *)robot_home);
#endif
    return 0;
}

#else

#include <dlfcn.h>

#include "plan.h"

typedef struct {
    const int32_t *code;
    const double *data;
    int64_t at;
    double *work, *state;
} call_t;

static call_t call;
static int64_t rows;
static double *q, *x, *J, *distance;
static void (*evaluate)(const call_t *, const double *, int64_t, double *, double *, double *, double);
static int32_t (*tick)(const call_t *);
static void (*steps)(const call_t *, int64_t, int32_t, const double *, const double *,
                     const double *, const double *, const double *, double *, unsigned char *);
static void (*find)(const call_t *, int64_t, int32_t, int32_t, int32_t, const double *,
                    const double *, double *, double *, double *, int32_t *, int32_t *);
static void (*look)(const call_t *, int64_t, const double *, double *, double *);
static const double tolerance = 1e-9;

static void *value(void *count) {
    return evaluate(&call, q, *(int64_t *)count, x, NULL, NULL, 0.0), NULL;
}
static void *slope(void *count) { return evaluate(&call, q, *(int64_t *)count, x, J, NULL, 0.0), NULL; }
static void *all(void *count) {
    return evaluate(&call, q, *(int64_t *)count, x, J, distance, 0.0), NULL;
}
static void *domain(void *count) {
    return evaluate(&call, q, *(int64_t *)count, NULL, J, distance, 0.0), NULL;
}
static void *ticks(void *none) { return tick(&call), none; }
static void *many_steps(void *none) {
    return steps(&call, rows, 15, q, x, x, x, q, J, (unsigned char *)distance), none;
}
static void *search(void *mode) {
    return find(&call, rows, *(int32_t *)mode, 30, 0, &tolerance, x, q, J, distance,
                (int32_t *)(distance + 24 * rows), (int32_t *)(distance + 25 * rows)),
           NULL;
}
static void *task(void *none) { return look(&call, rows, q, x, J), none; }

static void *filled(FILE *file, size_t size, size_t count) {
    void *array = calloc(count, size);
    if (!array || (file && fread(array, size, count, file) != count)) exit(2);
    return array;
}

int main(int argc, char **argv) {
    void *library = argc == 3 ? dlopen(argv[1], RTLD_NOW) : NULL;
    FILE *file = library ? fopen(argv[2], "rb") : NULL;
    if (!file) return 2;
    int32_t *head = filled(file, sizeof *head, 4);
    int32_t *code = filled(file, sizeof *code, (size_t)head[0]);
    double *data = filled(file, sizeof *data, (size_t)head[1]);
    const int at = head[2], n = code[at + HK_N], m = code[at + HK_M];
    rows = head[3];
    q = filled(file, sizeof *q, (size_t)(rows * n));
    x = filled(NULL, sizeof *x, (size_t)(rows * (m > 16 ? m : 16)));
    J = filled(NULL, sizeof *J, (size_t)(rows * (m * n + n + 27)));
    distance = filled(NULL, sizeof *distance, (size_t)(rows * (26 + n)));
    *(void **)&evaluate = dlsym(library, "hk_evaluate");
    *(void **)&tick = dlsym(library, "hk_ik_tick");
    *(void **)&steps = dlsym(library, "hk_ik_steps");
    *(void **)&find = dlsym(library, "hk_ik_find");
    *(void **)&look = dlsym(library, "hk_ik_look");
    int64_t (*work)(const int32_t *, int32_t);
    *(void **)&work = dlsym(library, "hk_work");
    call = (call_t){code, data, at, filled(NULL, 8, (size_t)work(code, at)), filled(NULL, 8, 4000)};
    int64_t counts[2] = {1, rows};
    if (code[at] != HK_IK) {
        for (int k = 0; k < 2; k++) {
            report(k ? "value of many" : "value", value, counts + k);
            report(k ? "J of many" : "J", slope, counts + k);
            report(k ? "x, J, distance of many" : "x, J, distance", all, counts + k);
            report(k ? "domain of many" : "domain", domain, counts + k);
        }
        return 0;
    }
    int32_t modes[2] = {3, 4};
    const int width = code[at + HK_MORE + 1] & IK_POSE ? IK_POSE_NUMBERS : m;
    look(&call, rows, q, x, J); /* targets that are reached */
    for (int j = 0; j < n; j++) call.state[IK_TARGET + 3 * width + 3 * m + j] = q[j];
    for (int i = 0; i < width; i++)
        call.state[IK_TARGET + i] = call.state[IK_TARGET + width + m + i] = x[i];
    call.state[IK_MODE] = 7.0;
    call.state[IK_PERIOD] = 0.01;
    report("tick", ticks, NULL);
    report("steps", many_steps, NULL);
    report("task", task, NULL);
    report("search", search, modes);
    report("search for a posture", search, modes + 1);
    return 0;
}
#endif
