/* Loops over the functions of an exported header, for benchmarks/export.py. */
#include "policy.h"
void act(int n, const float *states, const int *gates, const float *past, float *actions) {
    (void)past;
    for (int k = 0; k < n; k++)
        flytrack_policy(states + k * FLYTRACK_STATE, gates[k],
#if FLYTRACK_PAST
                        past + k * FLYTRACK_PAST,
#endif
                        actions + k * FLYTRACK_ACTION);
}
void advance(int n, const float *before, const float *after, int *gates) {
    for (int k = 0; k < n; k++)
        gates[k] = flytrack_next_gate(gates[k], before + k * FLYTRACK_STATE, after + k * FLYTRACK_STATE);
}
void lag(const float *action, float *applied) { flytrack_lag(action, applied); }
