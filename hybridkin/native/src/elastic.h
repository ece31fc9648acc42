/* Tendons that can only pull on an elastic backbone: which are taut, and the shape at balance.

   The length change and bendings y of segment k stretch a tendon by w . t_k - d, where t_k is y_k,
   and with the routing "base" the sum of y_0 to y_k; d is how far the tendon is paid out. At
   balance D_k t_k - E_k t_{k-1} - E_{k+1} t_{k+1} = sum of w d over the taut tendons of segment k,
   a block tridiagonal system with diagonal E. It is reduced from the last segment to the first:
   what the later segments add to D_k is their stiffness in series with the backbone's. */

/* What `pull` needs to know of a row besides z. */
typedef struct {
    V *inverse;       /* of the reduced D_k (S, 6) */
    V *taut;          /* (n), 1 or 0 */
    HK(loaded) loads; /* of a chain with errors of its structure */
} HK(inside);

#define HK_ELASTIC_WORK(n, S) (HK_USES(HK_ELASTIC) * (6 * (S) + (n)))

/* Sizes and numbers of a node. Of a segment these are its stiffnesses (3), its E (3), the arc at
   rest up to the tip (3), and the shares of t_k and of t_{k-1} in what is up to the tip; of a
   tendon its zero [m], the x and y of its w = (1, x, y), xx, xy, yy, and its gain [m per unit of
   q]. Then a linear map to n numbers: they guess which tendons are taut, by their signs. */
typedef struct {
    int n, S, tip, same;   /* tendons; segments, and up to the tip; tendons of each if all alike */
    const int32_t *counts; /* tendons that end at each segment */
    const real *segments, *tendons, *guess;
} HK(elastic_t);

#define HK_PASSED 3
#define HK_REST 6
#define HK_SHARE 9
#define HK_BEHIND 10
#define HK_SEGMENT 11 /* numbers of a segment */
#define HK_GAIN 6
#define HK_TENDON 7 /* numbers of a tendon */

static inline HK(elastic_t) HK(elastic_of)(const hk_plan *p, int at) {
    const int32_t *more = p->code + at + HK_MORE;
    HK(elastic_t) e = {p->code[at + HK_N], more[1], more[0], more[2], more + 3, NULL, NULL, NULL};
    e.segments = hk_numbers(p, at) + HK_FRAME + e.tip;
    e.tendons = e.segments + HK_SEGMENT * e.S;
    e.guess = e.tendons + HK_TENDON * e.n;
    return e;
}

/* The inverse of a symmetric, positive definite D (xx, xy, xz, yy, yz, zz), by D = L diag L'. One
   division: the pivots are D0, m / D0 and n / (D0 m), with the minors m and n of D0 D. */
HK_INLINE void HK(invert)(const V *D, V *inverse) {
    const V m = D[0] * D[3] - D[1] * D[1], yz = D[0] * D[4] - D[1] * D[2];
    const V n = m * (D[0] * D[5] - D[2] * D[2]) - yz * yz, first = D[0] * m;
    const V all = R(1.0) / (first * n), r0 = m * n * all, r1 = D[0] * D[0] * n * all;
    const V r2 = first * first * all, a = D[1] * r0, b = D[2] * r0, c = yz * r0 * r1;
    const V d = a * c - b, cr = c * r2, dr = d * r2;
    inverse[0] = r0 + a * a * r1 + d * dr;
    inverse[1] = -(a * r1 + c * dr);
    inverse[2] = dr;
    inverse[3] = r1 + c * cr;
    inverse[4] = -cr;
    inverse[5] = r2;
}

/* y (3) = A x for a symmetric A. */
HK_INLINE void HK(symmetric)(const V *A, const V *x, V *y) {
    const V a = x[0], b = x[1], c = x[2];
    y[0] = A[0] * a + A[1] * b + A[2] * c;
    y[1] = A[1] * a + A[3] * b + A[4] * c;
    y[2] = A[2] * a + A[4] * b + A[5] * c;
}

/* What tendons with the stiffness A are behind springs E: E D^-1 A for D = E + A, which takes no
   difference of large numbers. */
HK_INLINE void HK(in_series)(const real *E, const V *inverse, const V *A, V *passed) {
    V y[3];
    HK(symmetric)(inverse, (const V[3]){A[0], A[1], A[2]}, y);
    passed[0] = y[0] * E[0];
    HK(symmetric)(inverse, (const V[3]){A[1], A[3], A[4]}, y);
    passed[1] = y[0] * E[0];
    passed[3] = y[1] * E[1];
    HK(symmetric)(inverse, (const V[3]){A[2], A[4], A[5]}, y);
    for (int i = 0; i < 3; i++) passed[i == 2 ? 5 : 2 + 2 * i] = y[i] * E[i];
}

/* Solve the system in place: t (3 S) comes as its right-hand side. */
HK_INLINE void HK(balance)(HK(elastic_t) e, const HK(inside) * in, V *t) {
    for (int k = e.S - 1; k > 0; k--) {
        V moved[3];
        HK(symmetric)(in->inverse + 6 * k, t + 3 * k, moved);
        for (int i = 0; i < 3; i++)
            t[3 * k - 3 + i] =
                t[3 * k - 3 + i] + moved[i] * e.segments[HK_SEGMENT * k + HK_PASSED + i];
    }
    HK(symmetric)(in->inverse, t, t);
    for (int k = 1; k < e.S; k++) {
        for (int i = 0; i < 3; i++)
            t[3 * k + i] =
                t[3 * k + i] + t[3 * k - 3 + i] * e.segments[HK_SEGMENT * k + HK_PASSED + i];
        HK(symmetric)(in->inverse + 6 * k, t + 3 * k, t + 3 * k);
    }
}

/* Factor the system of the taut tendons, and solve it: t (3 S). */
HK_INLINE void HK(shape)(HK(elastic_t) e, const V *q, const HK(inside) * in, V *t) {
    int first = e.n;
    V passed[6] = {SPLAT(0.0), SPLAT(0.0), SPLAT(0.0), SPLAT(0.0), SPLAT(0.0), SPLAT(0.0)};
    for (int k = e.S - 1; k >= 0; k--) {
        const real *own = e.segments + HK_SEGMENT * k;
        const int count = e.same ? e.same : e.counts[k];
        V pulled[6], force[3] = {SPLAT(0.0), SPLAT(0.0), SPLAT(0.0)};
        for (int i = 0; i < 6; i++) pulled[i] = passed[i];
        first -= count;
        for (int i = 0; i < count; i++) {
            const real *of = e.tendons + HK_TENDON * (first + i);
            const V taut = in->taut[first + i], d = (q[first + i] * of[HK_GAIN] - of[0]) * taut;
            pulled[0] = pulled[0] + taut;
            for (int j = 1; j < 6; j++) pulled[j] = pulled[j] + taut * of[j];
            force[0] = force[0] + d;
            force[1] = force[1] + d * of[1];
            force[2] = force[2] + d * of[2];
        }
        V D[6], *inverse = in->inverse + 6 * k;
        for (int i = 0; i < 6; i++) D[i] = pulled[i];
        D[0] = D[0] + own[0];
        D[3] = D[3] + own[1];
        D[5] = D[5] + own[2];
        HK(invert)(D, inverse);
        HK(in_series)(own + HK_PASSED, inverse, pulled, passed);
        for (int i = 0; i < 3; i++) t[3 * k + i] = force[i];
    }
    HK(balance)(e, in, t);
}

/* Whether a tendon is still to change its role, `found` being the right one now: the first that is
   not wrong by rounding alone. `none` tells whether there was none before it. */
static inline M HK(first_wrong)(M found, M was, V stretch, V size, M *none) {
    const M wrong =
        (found != was) & (HK(max)(stretch, -stretch) > size * (R(4.0) * HK_EPS)) & *none;
    *none = *none & NOT(wrong);
    return wrong;
}

/* Find the taut tendons by block principal pivoting from a guess (Murty 1974, Judice & Pires
   1994), and the shape t (3 S) at balance. */
HK_INLINE void HK(settle)(HK(elastic_t) e, const V *q, const HK(inside) * in, V *t) {
    const int most = HK_WHOLE_STEPS + (1 << (e.n < HK_MOST_TURNS ? e.n : HK_MOST_TURNS));
    HK(affine)(e.n, e.n, e.guess, e.guess + e.n * e.n, q, in->taut);
    for (int i = 0; i < e.n; i++)
        in->taut[i] = SELECT(in->taut[i] >= SPLAT(0.0), SPLAT(1.0), SPLAT(0.0));
    for (int step = 0; step < most; step++) {
        HK(shape)(e, q, in, t);
        M changed = SPLAT(0.0) != SPLAT(0.0), none = NOT(changed);
        for (int k = 0, i = 0; k < e.S; k++)
            for (int last = i + (e.same ? e.same : e.counts[k]); i < last; i++) {
                const real *of = e.tendons + HK_TENDON * i;
                const V d = q[i] * of[HK_GAIN] - of[0], y = t[3 * k + 1] * of[1],
                        z = t[3 * k + 2] * of[2];
                const V stretch = t[3 * k] + y + z - d;
                const M found = stretch >= SPLAT(0.0), was = in->taut[i] > SPLAT(0.0);
                M turned = found != was;
                if (step >= HK_WHOLE_STEPS) {
                    const V size = HK(max)(d, -d) + HK(max)(t[3 * k], -t[3 * k]) + HK(max)(y, -y) +
                                   HK(max)(z, -z);
                    turned = HK(first_wrong)(found, was, stretch, size, &none);
                }
                in->taut[i] = SELECT(turned, SPLAT(1.0) - in->taut[i], in->taut[i]);
                changed = changed | turned;
            }
        if (!HK(any)(changed)) break;
    }
}

/* The arcs z (3 tip) of q; NaN as the length of one that would be too short. */
HK_INLINE void HK(elastic_arcs)(HK(elastic_t) e, const V *q, const HK(inside) * in, V *z) {
    V t[3 * HK_MAX_S];
    HK(settle)(e, q, in, t);
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < e.tip; k++) {
            const real *own = e.segments + HK_SEGMENT * k;
            z[i * e.tip + k] = t[3 * k + i] * own[HK_SHARE] + own[HK_REST + i];
            if (k) z[i * e.tip + k] = z[i * e.tip + k] - t[3 * k - 3 + i] * own[HK_BEHIND];
        }
    for (int k = 0; k < e.tip; k++) {
        const V least = SPLAT(R(HK_LEAST_LENGTH) * e.segments[HK_SEGMENT * k + HK_REST]);
        z[k] = SELECT(z[k] >= least, z[k], SPLAT(R(NAN)));
    }
}

/* J (rows, n) += C dz/dq, for C (rows, 3 tip): one balance of forces per row. */
HK_INLINE void HK(pull_tendons)(HK(elastic_t) e, const HK(inside) * in, int rows, const V *C,
                                V *J) {
    for (int row = 0; row < rows; row++, J += e.n, C += 3 * e.tip) {
        V t[3 * HK_MAX_S];
        for (int k = 0; k < e.S; k++)
            for (int i = 0; i < 3; i++) {
                const real *own = e.segments + HK_SEGMENT * k, *next = own + HK_SEGMENT;
                t[3 * k + i] = k < e.tip ? C[i * e.tip + k] * own[HK_SHARE] : SPLAT(0.0);
                if (k + 1 < e.tip)
                    t[3 * k + i] = t[3 * k + i] - C[i * e.tip + k + 1] * next[HK_BEHIND];
            }
        HK(balance)(e, in, t);
        for (int k = 0, j = 0; k < e.S; k++)
            for (int last = j + (e.same ? e.same : e.counts[k]); j < last; j++) {
                const real *of = e.tendons + HK_TENDON * j;
                const V by = t[3 * k] + t[3 * k + 1] * of[1] + t[3 * k + 2] * of[2];
                J[j] = J[j] + in->taut[j] * by * of[HK_GAIN];
            }
    }
}
