/* Small dense products with constant matrices. */

/* y (m) = A (m, n) x (n) + b (m). */
static inline __attribute__((always_inline)) void HK(affine)(
    int m, int n, const real *A, const real *b, const V *x, V *y) {
    for (int i = 0; i < m; i++) {
        V sum = SPLAT(b[i]);
        for (int j = 0; j < n; j++) sum = sum + x[j] * A[n * i + j];
        y[i] = sum;
    }
}

/* J (3, n) += C (3, k) A (k, n). */
static inline __attribute__((always_inline)) void HK(fold)(
    int k, int n, const V *C, const real *A, V *J) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < n; j++) {
            V sum = J[n * i + j];
            for (int l = 0; l < k; l++) sum = sum + C[k * i + l] * A[n * l + j];
            J[n * i + j] = sum;
        }
}
