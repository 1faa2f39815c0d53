"""An exported header, compiled, and states on which exported policies are compared."""

import ctypes
import subprocess

import numpy as np

from flytrack_env.state import ACTION_SIZE, BATTERY, POSITION, QUATERNION, STATE_SIZE, VELOCITY

WARNINGS = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-Wconversion")
FLAGS = (*WARNINGS, "-O2", "-shared", "-fPIC")
BEYOND = 1.2  # times the limits of the observation, so that clipping is compared too
LOOPS = """
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
        gates[k] = flytrack_next_gate(
            gates[k], before + k * FLYTRACK_STATE, after + k * FLYTRACK_STATE);
}
void lag(const float *action, float *applied) { flytrack_lag(action, applied); }
"""


class CompiledPolicy:
    """A header of ``export``, compiled; it is called policy.h."""

    def __init__(self, header):
        source, library = header.with_name("loops.c"), header.with_name("policy.so")
        source.write_text(LOOPS)
        command = ["gcc", *FLAGS, f"-I{header.parent}", str(source), "-o", str(library), "-lm"]
        subprocess.run(command, check=True)
        self.functions = ctypes.CDLL(str(library))

    def act(self, states, gates, past=()):
        """Return actions (N, 4) of states (N, 21), gates (N,) and, if read, past actions (N, P)."""
        actions = np.empty((len(states), ACTION_SIZE), np.float32)
        self._call(
            "act", len(states), np.float32(states), np.int32(gates), np.float32(past), actions
        )
        return actions

    def next_gates(self, before, after, gates):
        """Return the gates to fly, (N,), after steps from states to states, (N, 21)."""
        gates = np.array(gates, np.int32)
        self._call("advance", len(gates), np.float32(before), np.float32(after), gates)
        return gates

    def lag(self, action, applied):
        """Return the applied action, (4,), after a step."""
        applied = np.array(applied, np.float32)
        self._call("lag", np.float32(action), applied)
        return applied

    def _call(self, name, *arguments):
        pointers = [
            value if isinstance(value, int) else value.ctypes.data_as(ctypes.c_void_p)
            for value in arguments
        ]
        getattr(self.functions, name)(*pointers)


def states_in_box(policy, count, seed):
    """Return states (count, 21) and gates; observations fill the box and a fifth beyond it."""
    rng = np.random.default_rng(seed)
    gates = rng.integers(0, len(policy.centres), count)
    reach = BEYOND * policy.limits / policy.factors
    rows = rng.uniform(-reach, reach, (count, reach.size)) + policy.offsets
    states = np.zeros((count, STATE_SIZE))
    states[:, POSITION] = policy.centres[gates] + np.einsum(
        "nij,ni->nj", policy.frames[gates], rows[:, :3]
    )
    states[:, VELOCITY] = np.einsum("nij,ni->nj", policy.frames[gates], rows[:, 3:6])
    attitudes = rng.normal(size=(count, 4))
    states[:, QUATERNION] = attitudes / np.linalg.norm(attitudes, axis=1, keepdims=True)
    states[:, QUATERNION.stop : BATTERY + 1] = rows[:, 15:]
    return states.astype(np.float32), gates
