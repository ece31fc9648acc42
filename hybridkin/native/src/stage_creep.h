/* A stage of hysteresis: creep, with slow parts. Its numbers are the shares (count, n) of a change that
   come late, and the time constants (count). */

/* What of a change is still to come after the time of a stage, for each of its time constants. */
static inline void hk_late(const hk_stage *s, real *late) {
    const real *times = s->numbers + s->count * s->n;
    for (int i = 0; i < s->count; i++) late[i] = HK_MATH(exp)(-s->seconds / times[i]);
}

static inline void hk_creep_apply(const hk_stage *s, const real *u, real *slow, real *y) {
    const int n = s->n;
    const real *shares = s->numbers;
    real late[HK_MAX_CREEPS];
    hk_late(s, late);
    for (int j = 0; j < n; j++) y[j] = u[j];
    for (int i = 0; i < s->count; i++, slow += n, shares += n)
        for (int j = 0; j < n; j++) {
            const real behind = late[i] * (slow[j] - u[j]);
            slow[j] = u[j] + behind;
            y[j] += shares[j] * behind;
        }
}

static inline void hk_creep_command(const hk_stage *s, const real *u, real *slow, real *y,
                                    real *goal) {
    const int n = s->n;
    const real rounding = s->rounding;
    real late[HK_MAX_CREEPS];
    hk_late(s, late);
    for (int j = 0; j < n; j++) {
        real at_once = R(1.0), from = R(0.0), size = hk_larger(goal[j], -goal[j]);
        for (int i = 0; i < s->count; i++) {
            const real share = s->numbers[n * i + j] * late[i], part = share * slow[n * i + j];
            at_once -= share, from += part, size += hk_larger(part, -part);
        }
        /* Rounding is no reversal, after which a backlash before this stage would jump, and a share
           at once that is only rounding moves nothing. */
        const real stay = from + at_once * u[j], change = goal[j] - stay;
        const int moves = at_once > rounding && hk_larger(change, -change) > rounding * size;
        y[j] = moves ? goal[j] : stay;
        goal[j] = moves ? (goal[j] - from) / at_once : u[j];
    }
    for (int i = 0; i < s->count; i++, slow += n)
        for (int j = 0; j < n; j++) slow[j] = goal[j] + late[i] * (slow[j] - goal[j]);
}
