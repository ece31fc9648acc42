/* Small dense products with constant matrices. */

/* y (m) = A (m, n) x (n) + b (m). */
HK_INLINE void HK(affine)(
    int m, int n, const real *A, const real *b, const V *x, V *y) {
    for (int i = 0; i < m; i++) {
        V sum = SPLAT(b[i]);
        for (int j = 0; j < n; j++) sum = sum + x[j] * A[n * i + j];
        y[i] = sum;
    }
}

/* J (3, n) = C (3, k) T (k, n), for a T that differs from row to row. */
HK_INLINE void HK(multiply)(
    int k, int n, const V *C, const V *T, V *J) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < n; j++) {
            V sum = SPLAT(0.0);
            for (int l = 0; l < k; l++) sum = sum + C[k * i + l] * T[n * l + j];
            J[n * i + j] = sum;
        }
}

/* y += w x, for `length` of them. */
static inline void HK(add)(int length, real w, const V *x, V *y) {
    for (int i = 0; i < length; i++) y[i] = y[i] + x[i] * w;
}
