/* Backlash: the classical play operator, with half the width `half` (n) of every tendon. */

/* Follow the rows `given` (rows, n) from the last command and effective change (n), which become
   those after the last row. Commands are given and effective changes `found`; with `lead` the
   other way round. */
static inline void hk_play_rows(int64_t rows, int n, int lead, const real *half, const real *given,
                                real *command, real *effective, real *found) {
    for (int64_t r = 0; r < rows; r++, given += n, found += n)
        for (int j = 0; j < n; j++) {
            const real at = given[j], low = at - half[j], high = at + half[j];
            real y = effective[j];
            if (lead) {
                if (at != y) command[j] = at > y ? high : at < y ? low : at;
                effective[j] = at;
            } else {
                y = y < low ? low : y; /* a NaN stays */
                effective[j] = high < y ? high : y;
                command[j] = at;
            }
            found[j] = lead ? command[j] : effective[j];
        }
}
