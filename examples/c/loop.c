/* A control loop of 1 kHz around an exported step; prints when its commands were ready.

     hybridkin export MODEL --name robot --dt 0.001 --out robot_c
     cc -O2 -I robot_c examples/c/loop.c robot_c/robot.c -lm -o loop && ./loop

   Every line has the lower end of a bin [us], the number of commands that were ready so long after
   their deadline, and the number of steps that took so long. As root it runs under SCHED_FIFO. */
#define _GNU_SOURCE
#include <math.h>
#include <sched.h>
#include <stdio.h>
#include <sys/mman.h>
#include <time.h>

#include "robot.h"

#ifndef TICKS
#define TICKS 10000
#endif
#ifndef RADIUS
#define RADIUS 0.01 /* of the circle that the tip follows [m] */
#endif
enum { PERIOD = 1000000 /* ns */, TURN = 2000 /* ticks */, BINS = 100 /* ten per decade */ };

static long long now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static void count(long long *bins, long long time, long long *worst) {
    bins[time < 1 ? 0 : (int)(10.0 * log10((double)time))]++;
    if (time > *worst) *worst = time;
}

int main(void) {
    static long long after[BINS], step[BINS], worst_after, worst_step;
    const struct sched_param high = {.sched_priority = 80};
    const int fifo = sched_setscheduler(0, SCHED_FIFO, &high) == 0;
    const int locked = mlockall(MCL_CURRENT | MCL_FUTURE) == 0;
    robot_state state;
    robot_real center[3], target[3], dx[3] = {0, 0, 0}, off = 0;
    robot_forward(robot_home, center);
    robot_reset(&state, robot_home);
    long long deadline = now();
    for (int tick = 0; tick < TICKS; tick++) {
        const double rate = 2.0 * acos(-1.0) / TURN, angle = rate * tick;
        const double speed = RADIUS * rate * 1e9 / PERIOD;
        target[0] = center[0] + (robot_real)(RADIUS * (cos(angle) - 1.0));
        target[1] = center[1] + (robot_real)(RADIUS * sin(angle));
        target[2] = center[2];
        dx[0] = (robot_real)(-speed * sin(angle));
        dx[1] = (robot_real)(speed * cos(angle));
        deadline += PERIOD;
        const struct timespec t = {deadline / 1000000000LL, deadline % 1000000000LL};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL)) continue;
        const long long woken = now();
        robot_step(&state, target, dx, NULL); /* NULL: no measured tip */
        const long long ready = now();        /* send state.q here */
        count(after, ready - deadline, &worst_after);
        count(step, ready - woken, &worst_step);
        if (tick > TURN / 2 && state.error > off) off = state.error;
    }
    for (int i = 0; i < BINS; i++)
        if (after[i] + step[i])
            printf("%.3f %lld %lld\n", 1e-3 * pow(10.0, 0.1 * i), after[i], step[i]);
    printf("# SCHED_FIFO %d, locked %d; worst: command after %.3f us, step %.3f us; error %.3g mm\n",
           fifo, locked, 1e-3 * (double)worst_after, 1e-3 * (double)worst_step, 1e3 * (double)off);
    return 0;
}
