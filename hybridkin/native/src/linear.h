/* Memory of a call, and small dense products with constant matrices.

   What a function needs on its way, sized by the model, stands in memory that the caller owns, not
   on the stack: threads may have 128 KiB. `work` points to numbers that are free. A function takes
   from the front and passes the rest on; when it returns, all is free again. HK_..._WORK beside the
   functions tell how many numbers they take at most. */

static inline V *HK(take)(V **work, int count) {
    V *taken = *work;
    *work = taken + count;
    return taken;
}

/* y (m) = A (m, n) x (n) + b (m). */
HK_INLINE void HK(affine)(int m, int n, const real *A, const real *b, const V *x, V *y) {
    for (int i = 0; i < m; i++) {
        V sum = SPLAT(b[i]);
        for (int j = 0; j < n; j++) sum = sum + x[j] * A[n * i + j];
        y[i] = sum;
    }
}

/* J (3, n) = C (3, k) T (k, n), for a T that differs from row to row. */
HK_INLINE void HK(multiply)(int k, int n, const V *restrict C, const V *restrict T, V *restrict J) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < n; j++) {
            V sum = SPLAT(0.0);
            for (int l = 0; l < k; l++) sum = sum + C[k * i + l] * T[n * l + j];
            J[n * i + j] = sum;
        }
}

/* y += w x, for `length` of them. */
static inline void HK(add)(int length, real w, const V *restrict x, V *restrict y) {
    int i = 0;
    for (; HK_COMMON(i + 9 <= length); i += 9)
        for (int j = i; j < i + 9; j++) y[j] = y[j] + x[j] * w;
    for (; i < length; i++) y[i] = y[i] + x[i] * w;
}
