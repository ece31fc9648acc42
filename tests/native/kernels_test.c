/* Runs the kernels on a plan from a file, rows one by one and in blocks, for sanitizers.

   The file holds int32 numbers: lengths of code and data, place of the root, rows of q; then code
   (int32), data (float64) and q (float64). Prints the largest difference of x, J, the domain
   distance and its slope between both ways, relative to the largest number of each. Every array is
   as long as it must be, so that a sanitizer finds any access beside it. */

#include "hk.c"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static void *filled(FILE *file, size_t size, size_t count) {
    void *array = malloc(size * count);
    if (!array || (file && fread(array, size, count, file) != count)) {
        fputs("the file is too short\n", stderr);
        exit(2);
    }
    if (!file) memset(array, 0x7f, size * count);
    return array;
}

static double difference(const double *a, const double *b, size_t count) {
    double most = 0.0, size = 0.0;
    for (size_t i = 0; i < count; i++) {
        const int lost = a[i] != a[i];
        if (lost != (b[i] != b[i])) return INFINITY;
        if (lost || a[i] == b[i]) continue;
        most = fmax(most, fabs(a[i] - b[i]));
    }
    for (size_t i = 0; i < count; i++) size = fmax(size, fabs(a[i]));
    return size > 0.0 ? most / size : most;
}

int main(int argc, char **argv) {
    FILE *file = argc == 2 ? fopen(argv[1], "rb") : NULL;
    if (!file) return 2;
    int32_t *head = filled(file, sizeof *head, 4);
    const int at = head[2], rows = head[3];
    int32_t *code = filled(file, sizeof *code, (size_t)head[0]);
    double *data = filled(file, sizeof *data, (size_t)head[1]);
    const size_t n = (size_t)code[at + HK_N], m = (size_t)code[at + HK_M];
    double *q = filled(file, sizeof *q, (size_t)rows * n);
    fclose(file);
    const hk_call call = {code, data, at, filled(NULL, sizeof *data, (size_t)hk_work(code, at))};
    double worst[4] = {0.0, 0.0, 0.0, 0.0};
    for (int count = 1; count <= rows; count++) { /* full and partial blocks */
        const size_t N = (size_t)count;
        const size_t lengths[4] = {N * m, N * m * n, N, N * n};
        double *one[4], *block[4];
        for (int k = 0; k < 4; k++) {
            one[k] = filled(NULL, sizeof **one, lengths[k]);
            block[k] = filled(NULL, sizeof **block, lengths[k]);
        }
        for (size_t i = 0; i < N; i++) {
            hk_evaluate(&call, q + i * n, 1, NULL, one[3] + i * n, one[2] + i, 0.0);
            hk_evaluate(&call, q + i * n, 1, one[0] + i * m, one[1] + i * m * n, one[2] + i, 0.0);
        }
        hk_evaluate(&call, q, count, NULL, block[3], block[2], 0.0);
        hk_evaluate(&call, q, count, block[0], NULL, NULL, 0.0);
        worst[0] = fmax(worst[0], difference(one[0], block[0], lengths[0]));
        hk_evaluate(&call, q, count, block[0], block[1], block[2], 0.0);
        for (int k = 0; k < 4; k++) {
            worst[k] = fmax(worst[k], difference(one[k], block[k], lengths[k]));
            free(one[k]);
            free(block[k]);
        }
    }
    printf("%.3e %.3e %.3e %.3e\n", worst[0], worst[1], worst[2], worst[3]);
    free(q);
    free(call.work);
    free(data);
    free(code);
    free(head);
    return 0;
}
