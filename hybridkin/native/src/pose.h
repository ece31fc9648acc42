/* Poses of chains, and readouts of pose features: weights on the axes of a robot's frames, and on
   moments about them. */

/* The tip x (3) of arcs z (3 S) in the measuring frame, its axes as the columns of `turn` (3, 3), and
   where C is not NULL the motion and the angular velocity C (6, 3 S) by the arcs. */
static inline void HK(arcs_pose)(int S, const real *frame, const V *z, V *x, V *turn, V *C,
                                 V *work) {
    HK(posed) *segments = (HK(posed) *)HK(take)(&work, HK_POSED * S);
    V axes[3][3];
    for (int j = 0; j < 3; j++) {
        x[j] = SPLAT(frame[9 + j]);
        for (int axis = 0; axis < 3; axis++) axes[axis][j] = SPLAT(frame[3 * j + axis]);
    }
    for (int k = 0; k < S; k++)
        HK(follow)(z[k], z[S + k], z[2 * S + k], frame[HK_FRAME + k], axes, x, segments + k);
    for (int i = 0; i < 9; i++) turn[i] = axes[i % 3][i / 3];
    for (int k = 0; C && k < S; k++) {
        const HK(posed) *s = segments + k;
        V lever[3];
        for (int i = 0; i < 3; i++) lever[i] = x[i] - s->arc_end[i];
        for (int part = 0; part < 3; part++) {
            V move[3], spin[3], turned[3];
            for (int i = 0; i < 3; i++) {
                const V a = s->before[i], b = s->before[3 + i], c = s->before[6 + i];
                move[i] = a * s->moves[part][0] + b * s->moves[part][1] + c * s->moves[part][2];
                spin[i] = a * s->spins[part][0] + b * s->spins[part][1] + c * s->spins[part][2];
            }
            HK(cross)(spin, lever, turned);
            for (int i = 0; i < 3; i++) {
                C[(3 * i + part) * S + k] = move[i] + turned[i];
                C[(9 + 3 * i + part) * S + k] = spin[i];
            }
        }
    }
}

/* The tip x (3) of a chain, its axes `turn` (3, 3) and, where J is not NULL, their motion and angular
   velocity J (6, n). */
static inline void HK(chain_pose)(const hk_plan *p, int at, const V *q, V *x, V *turn, V *J,
                                  V *work) {
    const int32_t *more = p->code + at + HK_MORE;
    const int n = p->code[at + HK_N], k = HK(n_coordinates)(p, at);
    const real *numbers = hk_numbers(p, at);
    V *z = HK(take)(&work, k), *C = HK(take)(&work, 6 * k);
    HK(inside) in = HK(inside_of)(p, at, &work);
    if (!J) C = NULL;
    HK(coordinates)(p, at, q, z, &in);
    if (HK_CHAIN_IS(p, at, HK_RIGID))
        HK(rigid)(more[0], more + 2, numbers, z, x, C, turn, work);
    else if (HK_USES(HK_ARCS) || HK_USES(HK_ELASTIC))
        HK(arcs_pose)(more[0], numbers, z, x, turn, C, work);
    for (int i = 0; J && i < 6 * n; i++) J[i] = SPLAT(0.0);
    if (J) HK(pull_rows)(p, at, &in, 6, C, J);
}

#define HK_CHAIN_POSE_WORK(n, S)                                                                   \
    (7 * HK_MOST_Z(n, S) + HK_INSIDE_WORK(n, S) + HK_RIGID_WORK(n) + 51 * (S))

/* What a weighted sum of features does: its value, and by virtual work its slope by the arcs (3 S),
   for forces w on the lever from the base (3), then on the vectors of every frame (18; the last has
   no moments). Forces on a frame turn as one with every segment before it; every segment after it
   moves the end of its lever. */
static inline V HK(virtual_work)(int S, const HK(posed) * s, V reach, const real *w, V *by_arcs) {
    const V *end = s[S - 1].end;
    V pulls[HK_MAX_S][3], turns[HK_MAX_S][3], value = SPLAT(0.0), turned[3], pull[3];
    for (int i = 0; i < 3; i++) {
        pull[i] = SPLAT(w[i]);
        value = value + end[i] / reach * w[i];
    }
    w += 3;
    for (int k = 0; k < S; k++, w += 18) {
        for (int i = 0; i < 3; i++) {
            pulls[k][i] = pull[i];
            turns[k][i] = SPLAT(0.0);
        }
        for (int v = 0; v < (k < S - 1 ? 6 : 3); v++) {
            const V force[3] = {SPLAT(w[3 * v]), SPLAT(w[3 * v + 1]), SPLAT(w[3 * v + 2])};
            const V *vector = s[k].vectors[v];
            value = value + force[0] * vector[0] + force[1] * vector[1] + force[2] * vector[2];
            HK(cross)(vector, force, turned);
            for (int i = 0; i < 3; i++) turns[k][i] = turns[k][i] + turned[i];
            if (v < 3) continue;
            HK(cross)(force, s[k].vectors[v - 3], turned);
            for (int i = 0; i < 3; i++) pull[i] = pull[i] + turned[i];
        }
    }
    V turn[3] = {SPLAT(0.0), SPLAT(0.0), SPLAT(0.0)};
    for (int k = S - 1; by_arcs && k >= 0; k--) {
        V lever[3], force[3], moment[3], local[2][3];
        for (int i = 0; i < 3; i++) {
            turn[i] = turn[i] + turns[k][i];
            force[i] = pulls[k][i] / reach;
            lever[i] = end[i] - s[k].arc_end[i];
        }
        HK(cross)(lever, force, moment);
        for (int i = 0; i < 3; i++) moment[i] = moment[i] + turn[i];
        for (int i = 0; i < 3; i++) {
            const V *axis = s[k].before + 3 * i;
            local[0][i] = axis[0] * force[0] + axis[1] * force[1] + axis[2] * force[2];
            local[1][i] = axis[0] * moment[0] + axis[1] * moment[1] + axis[2] * moment[2];
        }
        for (int part = 0; part < 3; part++) {
            by_arcs[part * S + k] = SPLAT(0.0);
            for (int i = 0; i < 3; i++)
                by_arcs[part * S + k] = by_arcs[part * S + k] + local[0][i] * s[k].moves[part][i] +
                                        local[1][i] * s[k].spins[part][i];
        }
    }
    return value;
}

/* Numbers of a pose, then z and the slope by them, for every segment. */
#define HK_POSE_WORK(n, S) (HK_USES(HK_READOUT) * (57 * (S) + HK_ELASTIC_WORK(n, S)))

/* value (n_out) += W phi(q) and slope (n_out, n), where not NULL, += its derivative, for weights W
   (n_out, 18 S - 6) of the pose features of a chain of arcs, which ends at the robot's end. */
static inline void HK(pose_readout)(const hk_plan *p, int at, int n_out, const real *weights,
                                    const V *q, V *value, V *slope, V *work) {
    const int S = p->code[at + HK_MORE], n = p->code[at + HK_N];
    const real *frame = hk_numbers(p, at);
    const V reach = SPLAT(frame[HK_FRAME - 1]);
    V *z = HK(take)(&work, 3 * S), *by_arcs = HK(take)(&work, 3 * S);
    V axes[3][3], end[3] = {SPLAT(0.0), SPLAT(0.0), SPLAT(0.0)};
    HK(posed) *segments = (HK(posed) *)HK(take)(&work, HK_POSED * S);
    HK(inside) in = HK(inside_of)(p, at, &work);
    HK(coordinates)(p, at, q, z, &in);
    for (int i = 0; i < 9; i++) axes[i / 3][i % 3] = SPLAT(i % 4 == 0 ? 1.0 : 0.0);
    for (int k = 0; k < S; k++)
        HK(follow)(z[k], z[S + k], z[2 * S + k], frame[HK_FRAME + k], axes, end, segments + k);
    for (int k = 0; k < S; k++) {
        HK(posed) *s = segments + k;
        V lever[3];
        for (int i = 0; i < 3; i++) lever[i] = (end[i] - s->end[i]) / reach;
        for (int axis = 0; axis < 3; axis++) {
            const V *after = k + 1 < S ? segments[k + 1].before + 3 * axis : axes[axis];
            for (int i = 0; i < 3; i++) s->vectors[axis][i] = after[i];
            HK(cross)(after, lever, s->vectors[3 + axis]);
        }
    }
    for (int i = 0; i < n_out; i++, weights += 18 * S - 6) {
        const V more = HK(virtual_work)(S, segments, reach, weights, slope ? by_arcs : NULL);
        value[i] = value[i] + more;
        if (slope) HK(pull_rows)(p, at, &in, 1, by_arcs, slope + n * i);
    }
}
