/* Mechanical models, taken apart: q -> inner coordinates z -> tip x. Serial coupling acts on z. */

static inline HK(linear_arcs) HK(linear_arcs_of)(const hk_plan *p, int at) {
    const int32_t *more = p->code + at + HK_MORE;
    HK(linear_arcs) a = {more[0], more[1], more[2], NULL, NULL};
    a.zero = hk_numbers(p, at) + HK_FRAME + a.S;
    a.matrix = a.zero + 3 * a.S;
    return a;
}

static inline int HK(n_coordinates)(const hk_plan *p, int at) {
    return (HK_CHAIN_IS(p, at, HK_RIGID) ? 1 : 3) * p->code[at + HK_MORE];
}

/* The place of a chain without errors of its structure: of one with them, that of its whole robot. */
static inline int HK(robot)(const hk_plan *p, int at) {
    return HK_CHAIN_IS(p, at, HK_STRUCTURAL) ? p->code[at + HK_MORE + 1] : at;
}

/* Memory for what `pull` needs. */
static inline HK(inside) HK(inside_of)(const hk_plan *p, int at, V **work) {
    const int robot = HK(robot)(p, at);
    HK(inside) in = {0};
    if (HK_CHAIN_IS(p, robot, HK_ELASTIC)) {
        in.inverse = HK(take)(work, 6 * p->code[robot + HK_MORE + 1]);
        in.taut = HK(take)(work, p->code[robot + HK_N]);
    }
    if (robot != at) in.loads = HK(loaded_of)(HK(structure_of)(p, at).S, work);
    return in;
}

#define HK_INSIDE_WORK(n, S) (HK_ELASTIC_WORK(n, S) + HK_LOADED_WORK(S))

/* How far the n actuators of a rigid arm move its joints (joints, n), NULL where they are them. */
static inline const real *HK(couplings)(const hk_plan *p, int at) {
    const int32_t *more = p->code + at + HK_MORE;
    return more[1] ? hk_numbers(p, at) + 12 * more[0] + 12 : NULL;
}

/* The inner coordinates z of q, and what `pull` needs, without errors of the structure. */
static inline void HK(robot_coordinates)(const hk_plan *p, int at, const V *q, V *z,
                                         const HK(inside) * in) {
    (void)in;
    if (HK_CHAIN_IS(p, at, HK_RIGID)) {
        const int n = p->code[at + HK_N];
        const real *A = HK(couplings)(p, at);
        for (int i = 0; i < HK(n_coordinates)(p, at); i++) {
            z[i] = A ? SPLAT(0.0) : q[i];
            for (int j = 0; A && j < n; j++) z[i] = z[i] + q[j] * A[n * i + j];
        }
    } else if (HK_CHAIN_IS(p, at, HK_ELASTIC)) {
        HK(elastic_t) e = HK(elastic_of)(p, at);
        if (HK_COMMON(e.S == 3 && e.same == 3)) {
            e.S = e.same = 3;
            e.n = 9;
            HK(elastic_arcs)(e, q, in, z);
        } else
            HK(elastic_arcs)(e, q, in, z);
    } else if (HK_USES(HK_ARCS)) {
        HK(linear_arcs) a = HK(linear_arcs_of)(p, at);
        if (HK_COMMON(a.S == 3 && a.width == 3))
            HK(arcs_of)((HK(linear_arcs)){3, 3, 3, a.matrix, a.zero}, q, z);
        else if (HK_COMMON(a.S == 3 && a.width == 9))
            HK(arcs_of)((HK(linear_arcs)){3, 0, 9, a.matrix, a.zero}, q, z);
        else
            HK(arcs_of)(a, q, z);
    }
}

/* The inner coordinates z of q, and what `pull` needs. */
static inline void HK(coordinates)(const hk_plan *p, int at, const V *q, V *z,
                                   const HK(inside) * in) {
    const int robot = HK(robot)(p, at);
    HK(robot_coordinates)(p, robot, q, robot == at ? z : in->loads.arcs, in);
    if (robot == at) return;
    HK(structure) s = HK(structure_of)(p, at);
    if (HK_COMMON(s.S == 3 && s.tip == 3)) {
        s.S = s.tip = 3;
        HK(change_arcs)(s, &in->loads, z);
    } else
        HK(change_arcs)(s, &in->loads, z);
}

/* The tip x (3) of inner coordinates z, and its derivative C (3, k) where not NULL. */
static inline void HK(from_coordinates)(const hk_plan *p, int at, const V *z, V *x, V *C, V *work) {
    const int32_t *more = p->code + at + HK_MORE;
    (void)work;
    if (HK_CHAIN_IS(p, at, HK_RIGID))
        HK(rigid)(more[0], more + 2, hk_numbers(p, at), z, x, C, NULL, work);
    else if (HK_USES(HK_ARCS) || HK_USES(HK_ELASTIC))
        HK(arcs_tip)(more[0], hk_numbers(p, at), z, x, C);
}

/* J (rows, n) += C dz/dq, for C (rows, k), without errors of the structure. */
HK_INLINE void HK(pull_robot)(const hk_plan *p, int at, const HK(inside) * in, int rows, const V *C,
                              V *J) {
    const int n = p->code[at + HK_N];
    (void)in, (void)n;
    if (HK_CHAIN_IS(p, at, HK_RIGID)) {
        const int k = HK(n_coordinates)(p, at);
        const real *A = HK(couplings)(p, at);
        for (int i = 0; i < rows * n; i++) {
            if (!A) J[i] = J[i] + C[i];
            for (int l = 0; A && l < k; l++) J[i] = J[i] + C[i / n * k + l] * A[n * l + i % n];
        }
    } else if (HK_CHAIN_IS(p, at, HK_ELASTIC)) {
        HK(elastic_t) e = HK(elastic_of)(p, at);
        if (HK_COMMON(e.S == 3 && e.same == 3)) {
            e.S = e.same = 3;
            e.n = 9;
            HK(pull_tendons)(e, in, rows, C, J);
        } else
            HK(pull_tendons)(e, in, rows, C, J);
    } else if (HK_USES(HK_ARCS)) {
        HK(linear_arcs) a = HK(linear_arcs_of)(p, at);
        if (HK_COMMON(a.S == 3 && a.width == 3 && n == 9))
            HK(pull_arcs)((HK(linear_arcs)){3, 3, 3, a.matrix, a.zero}, rows, 9, C, J);
        else if (HK_COMMON(a.S == 3 && a.width == 9))
            HK(pull_arcs)((HK(linear_arcs)){3, 0, 9, a.matrix, a.zero}, rows, 9, C, J);
        else
            HK(pull_arcs)(a, rows, n, C, J);
    }
}

/* J (rows, n) += C dz/dq, for C (rows, k) of at most 6 rows. */
HK_INLINE void HK(pull_rows)(const hk_plan *p, int at, const HK(inside) * in, int rows, const V *C,
                             V *J) {
    const int robot = HK(robot)(p, at);
    if (robot != at) {
        HK(structure) s = HK(structure_of)(p, at);
        if (HK_COMMON(s.S == 3 && s.tip == 3)) {
            s.S = s.tip = 3;
            HK(pull_change)(s, &in->loads, rows, C);
        } else
            HK(pull_change)(s, &in->loads, rows, C);
        C = in->loads.by_arcs;
    }
    HK(pull_robot)(p, robot, in, rows, C, J);
}

/* J (3, n) += C dz/dq, for C (3, k). */
static inline void HK(pull)(const hk_plan *p, int at, const HK(inside) * in, const V *C, V *J) {
    HK(pull_rows)(p, at, in, 3, C, J);
}

#define HK_CHAIN_WORK(n, S) (4 * HK_MOST_Z(n, S) + HK_INSIDE_WORK(n, S) + HK_RIGID_WORK(n))

static inline void HK(chain)(const hk_plan *p, int at, const V *q, V *x, V *J, V *work) {
    const int k = HK(n_coordinates)(p, at);
    V *z = HK(take)(&work, k), *C = HK(take)(&work, 3 * k);
    HK(inside) in = HK(inside_of)(p, at, &work);
    if (HK_CHAIN_IS(p, at, HK_RIGID) && !HK(couplings)(p, at)) { /* q are its coordinates */
        HK(from_coordinates)(p, at, q, x, J, work);
        return;
    }
    HK(coordinates)(p, at, q, z, &in);
    HK(from_coordinates)(p, at, z, x, J ? C : NULL, work);
    if (!J) return;
    for (int i = 0; i < 3 * p->code[at + HK_N]; i++) J[i] = SPLAT(0.0);
    HK(pull)(p, at, &in, C, J);
}
