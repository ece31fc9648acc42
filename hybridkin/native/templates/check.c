/* Compares @NAME@ with numbers that hybridkin computed with torch; exit code 0 if all agree. */
#include <math.h>
#include <stdio.h>

#include "@NAME@.h"

enum { ROWS = @ROWS@, N = @N@, M = @M@ };

/* Rows inside the domain, then rows further and further from it, and one of NaN. */
static const @REAL@ q[ROWS * N] = {@Q@};
static const double x[ROWS * M] = {@X@};
static const double J[ROWS * M * N] = {@J@};
static const double distance[ROWS] = {@DISTANCE@};
static int failures = 0;

/* Compares n numbers, relative to the largest of them or to `scale`. */
static void check(const char *what, int row, const @REAL@ *found, const double *wanted, int n,
                  double scale, double *worst) {
    for (int i = 0; i < n; i++)
        if (fabs(wanted[i]) > scale) scale = fabs(wanted[i]);
    for (int i = 0; i < n; i++) {
        const double error = fabs((double)found[i] - wanted[i]) / scale;
        if (error > *worst) *worst = error;
        if (error <= @TOL@ || (isnan(found[i]) && isnan(wanted[i]))) continue;
        printf("%s, row %d, entry %d: %.17g, not %.17g\n", what, row, i, (double)found[i], wanted[i]);
        failures++;
    }
}
@TICKS@
int main(void) {
    double worst[4] = {0.0, 0.0, 0.0, 0.0};
    for (int row = 0; row < ROWS; row++) {
        const @REAL@ *at = q + N * row;
        @REAL@ own_x[M], own_J[M * N], far = @NAME@_domain(at);
        @NAME@_forward(at, own_x);
        check("forward", row, own_x, x + M * row, M, @X_SCALE@, worst);
        @NAME@_jacobian(at, own_x, own_J);
        check("jacobian", row, own_x, x + M * row, M, @X_SCALE@, worst);
        if (row < ROWS - 1) check("jacobian", row, own_J, J + M * N * row, M * N, @J_SCALE@, worst + 1);
        check("domain", row, &far, distance + row, 1, 1.0, worst + 2);
    }
#ifdef STEPS_ARE_CHECKED
    check_steps(worst + 3);
#endif
    printf("@NAME@: %d failures; largest relative errors: x %.2g, J %.2g, domain %.2g, step %.2g\n",
           failures, worst[0], worst[1], worst[2], worst[3]);
    return failures != 0;
}
