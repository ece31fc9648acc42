/* Rigid serial arms. Every joint moves about or along the z-axis of its frame. */

#define HK_RIGID_WORK(n) (HK_USES(HK_RIGID) * 6 * (n))

/* The tip x (3) and its derivative J (3, n) where not NULL. The numbers are the pose of every
   joint's frame in the frame before it, turned so that its axis is z (rotation (3, 3), position
   (3)); of the first one in the measuring frame; then position and rotation of the tip in the last
   one. `slides` (n): which joints are prismatic. Where `frame` is not NULL it becomes the
   rotation (3, 3) of the tip, and J (6, n) also has the rows of its angular velocity. */
static inline void HK(rigid)(int n, const int32_t *slides, const real *numbers, const V *q, V *x,
                             V *J, V *frame, V *work) {
    V turn[9], at[3] = {SPLAT(0.0), SPLAT(0.0), SPLAT(0.0)};
    V *axes = HK(take)(&work, 3 * n), *points = HK(take)(&work, 3 * n); /* (n, 3) */
    for (int i = 0; i < 9; i++) turn[i] = SPLAT(i % 4 == 0 ? 1.0 : 0.0);
    for (int k = 0; k < n; k++, numbers += 12) {
        V sine = SPLAT(0.0), cosine = SPLAT(1.0);
        if (!slides[k]) HK(sincos)(q[k], &sine, &cosine);
        for (int i = 0; i < 3; i++) {
            const V a = turn[3 * i], b = turn[3 * i + 1], c = turn[3 * i + 2];
            V column[3];
            at[i] = at[i] + a * numbers[9] + b * numbers[10] + c * numbers[11];
            for (int j = 0; j < 3; j++)
                column[j] = a * numbers[j] + b * numbers[3 + j] + c * numbers[6 + j];
            points[3 * k + i] = at[i];
            axes[3 * k + i] = turn[3 * i + 2] = column[2];
            turn[3 * i] = column[0] * cosine + column[1] * sine;
            turn[3 * i + 1] = column[1] * cosine - column[0] * sine;
            if (slides[k]) at[i] = at[i] + column[2] * q[k];
        }
    }
    for (int i = 0; i < 3; i++)
        x[i] = at[i] + turn[3 * i] * numbers[0] + turn[3 * i + 1] * numbers[1] +
               turn[3 * i + 2] * numbers[2];
    for (int i = 0; frame && i < 9; i++) {
        const V *row = turn + i / 3 * 3;
        const real *column = numbers + 3 + i % 3;
        frame[i] = row[0] * column[0] + row[1] * column[3] + row[2] * column[6];
    }
    for (int i = 0; frame && J && i < 3 * n; i++)
        J[3 * n + i] = slides[i % n] ? SPLAT(0.0) : axes[i % n * 3 + i / n];
    for (int k = 0; J && k < n; k++)
        for (int i = 0; i < 3; i++) {
            const int j = (i + 1) % 3, l = (i + 2) % 3;
            if (slides[k])
                J[n * i + k] = axes[3 * k + i] + (x[i] - x[i]); /* NaN in a row of NaN */
            else
                J[n * i + k] = axes[3 * k + j] * (x[l] - points[3 * k + l]) -
                               axes[3 * k + l] * (x[j] - points[3 * k + j]);
        }
}
