"""A checkpoint's policy as arrays: from the drone's state and the gate to fly to the stick commands.

It is what the evaluator computes: observation before the gate, network, mean action, clipped to [-1, 1].
Noise of sensors and drawn models are of the environment, and no part of it.
"""

from itertools import count, takewhile
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo.checkpoint import Checkpoint, CheckpointError
from baselines.purejaxrl_ppo.race_env import simulated_env
from flytrack_env.observations import BATTERY_MIDDLE_V, OBSERVATION, Entry, observe_race
from flytrack_env.params import EnvParams
from flytrack_env.state import STATE_SIZE, unpack

OF_NEXT_GATE = ("next_gate", "next_direction")  # the last entries of OBSERVATION, which no state changes
OF_DRONE = tuple(entry for entry in OBSERVATION if entry.key not in OF_NEXT_GATE)
KINDS_OF_PAST = ("commanded", "applied")
SENTENCES = {
    "state": (
        "0:3 position, world, m; 3:6 velocity, world, m/s; 6:9 acceleration, not read; 9:13 attitude, "
        "quaternion w, x, y, z of norm 1, body to world; 13:16 angular velocity, body, rad/s; 16:20 applied "
        "action, that is the command after the drone's lag: roll, pitch, yaw, thrust; 20 battery, V. World: "
        "the track's, z up. Body: x forward, y left, z up."
    ),
    "gate": "index of the gate to fly, 0 to {last_gate}, in the order of the track {track}.",
    "past": (
        "the last {num_actions} {kind} actions, the latest first, each roll, pitch, yaw, thrust in [-1, 1]; "
        "at the start of a flight all of them are the applied action."
    ),
    "action": (
        "roll, pitch, yaw, thrust in [-1, 1]. Full stick asks for {full_stick} deg/s about body x, y, z; "
        "thrust is -1 for none and 1 for full."
    ),
}


class ExportedPolicy(NamedTuple):
    """A policy as arrays, float64, and what its files say about it.

    centres: (gates, 3), world, m. frames: (gates, 3, 3), rows forward, left, up, world. free: (gates,), m,
    half of the opening less the drone's radius. next_rows: (gates, 6), the observation of the gate after.
    offsets, factors, limits: (23,), of the rows before these: clip((quantity - offset) * factor, +-limit).
    past: the entries of earlier actions, behind them. layers: kernel (inputs, outputs) and bias, tanh
    between. blend: (4,), how much of the way to the command the lags of the checkpoint's model go in a step.
    about: sentences. meanings: of inputs and output, by name.
    """

    centres: np.ndarray
    frames: np.ndarray
    free: np.ndarray
    next_rows: np.ndarray
    offsets: np.ndarray
    factors: np.ndarray
    limits: np.ndarray
    past: tuple[Entry, ...]
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    blend: np.ndarray
    about: str
    meanings: dict[str, str]

    @property
    def num_past(self) -> int:
        """How many numbers of earlier actions it reads."""
        return sum(entry.size for entry in self.past)


def policy_of(checkpoint: Checkpoint, name: str, track: str | None = None) -> ExportedPolicy:
    """Return the policy of a checkpoint on a track, by default its own; name: of the checkpoint's file.

    Raises:
        CheckpointError, TrackError: a checkpoint that does not fit its environment, whose policy remembers,
            or whose observation has rows that cannot be exported; a track that cannot be used.
    """
    if checkpoint.config.memory_size:
        raise CheckpointError(
            f"{name}: memory_size: found {checkpoint.config.memory_size}, expected 0: no policy that "
            "remembers can be exported yet"
        )
    env = simulated_env(checkpoint, track)
    past = env.observation_table[len(OBSERVATION) :]
    unknown = [entry.key for entry in past if entry.key.rpartition("_")[0] not in KINDS_OF_PAST]
    if unknown:
        raise CheckpointError(
            f"{name}: observation: found {', '.join(unknown)}, expected rows of {' or '.join(KINDS_OF_PAST)} "
            "actions after those of FlyTrack-v0"
        )
    params = env.default_params
    sizes = [entry.size for entry in OF_DRONE]
    rate = f"{1.0 / params.dt:g} commands a second"
    words = {
        "last_gate": len(env.track.gates) - 1,
        "track": env.track.name,
        "num_actions": len(past),
        "kind": past[0].key.rpartition("_")[0] if past else "",
        "full_stick": ", ".join(f"{value:.0f}" for value in params.model.max_rate),
    }
    return ExportedPolicy(
        **_gates(params),
        offsets=np.repeat([BATTERY_MIDDLE_V if entry.key == "battery" else 0.0 for entry in OF_DRONE], sizes),
        factors=np.repeat([1.0 / entry.scale for entry in OF_DRONE], sizes),
        limits=np.repeat([entry.limit for entry in OF_DRONE], sizes),
        past=past,
        layers=_layers(checkpoint),
        blend=1.0 - np.exp(-params.dt / np.asarray(params.model.tau, float)),
        about=f"FlyTrack {flytrack_env.__version__}: policy of {name}, track {env.track.name}, {rate}.",
        meanings={key: text.format(**words) for key, text in SENTENCES.items() if past or key != "past"},
    )


def _gates(params: EnvParams) -> dict[str, np.ndarray]:
    """Return the fields that depend on the gates."""
    gates = jax.tree.map(lambda leaf: np.asarray(leaf, float), params.course.gates)
    following = jax.tree.map(lambda leaf: np.roll(leaf, -1, axis=0), gates)
    with jax.enable_x64(True):
        anywhere = unpack(jnp.zeros(STATE_SIZE))
        rows = jax.vmap(lambda *pair: jnp.stack(observe_race(anywhere, *pair)))(gates, following)
    axes = [np.stack(axis, axis=-1) for axis in (gates.forward, gates.left(), gates.up)]
    return {
        "centres": np.stack(gates.centre, axis=-1),
        "frames": np.stack(axes, axis=1),
        "free": gates.half_opening - params.drone_radius,
        "next_rows": np.asarray(rows)[:, sum(entry.size for entry in OF_DRONE) :],
    }


def _layers(checkpoint: Checkpoint) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Return the actor's layers, with the initial action in the last bias."""
    tower = checkpoint.params["params"]["actor_tower"]
    names = takewhile(tower.__contains__, (f"layers_{2 * i}" for i in count()))  # tanh has the odd numbers
    layers = [
        (np.asarray(tower[name]["kernel"], float), np.asarray(tower[name]["bias"], float)) for name in names
    ]
    kernel, bias = layers[-1]
    return (*layers[:-1], (kernel, bias + checkpoint.config.initial_action))
