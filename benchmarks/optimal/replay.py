"""Replays of references: their commands, open loop, in the environment at 100 Hz."""

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env import EnvParams, EnvState, FlyTrack, ModelParameters
from flytrack_env.plants import Plant
from flytrack_env.quaternion import Vec3
from flytrack_env.references import Reference
from flytrack_env.state import POSITION, pack, unpack, unpack_action
from flytrack_env.tracks import Track, cross_gate


class Replay(NamedTuple):
    """The outcome of a reference's commands.

    states: (N + 1, 21), float32. gates_passed: in order, by the environment. time_s: to the last gate as the
    environment interpolates it, NaN if it was not passed. ended_by: causes of termination. drift_m: largest
    distance from the reference. frames_touched: of all gates, also those that were not next.
    """

    states: np.ndarray
    gates_passed: int
    time_s: float
    ended_by: tuple[str, ...]
    drift_m: float
    frames_touched: int


@cache
def _environment(plant: Plant | None) -> tuple[FlyTrack, Any]:
    """Return the environment and its compiled step, shared by all tracks and models of one form."""
    env = FlyTrack(plant=plant)

    def fly(state: EnvState, command: jax.Array, params: EnvParams) -> tuple[EnvState, Any]:
        after, _, causes, _ = env.transition(state, unpack_action(command), params)
        return after, (pack(env.drone(after)), causes, env.race(after))

    return env, jax.jit(fly)


def _params(track: Track, model: ModelParameters, dt_s: float) -> EnvParams:
    model = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), model)
    params = FlyTrack(track=track, model=model).default_params.replace(dt=dt_s)
    return jax.device_put(params)  # once, not in every step


def _frames_touched(positions: np.ndarray, params: EnvParams) -> int:
    """Return the number of gates whose frames the lines between positions, (N, 3), touch."""
    lines = (
        Vec3(*(jnp.asarray(axis)[:, None] for axis in ends.T)) for ends in (positions[:-1], positions[1:])
    )
    crossing = cross_gate(params.course.gates, *lines, params.drone_radius)
    return int(np.asarray(crossing.is_frame).any(axis=0).sum())


def replay(reference: Reference, track: Track, plant: Plant | None = None) -> Replay:
    """Return how a reference's commands fly, open loop, as judged by the environment.

    The environment is that of ``FlyTrack-v0`` with the reference's model, float32, or with another plant,
    such as a black box; the flight ends at the first cause of termination.
    """
    env, step = _environment(plant)
    params = _params(track, reference.model, reference.dt_s)
    first = jnp.asarray(reference.states[0], jnp.float32)
    state, steps = env.begin(unpack(first), 0, params), []
    for command in np.asarray(reference.commands, np.float32):
        state, outputs = step(state, command, params)
        steps.append(outputs)
    packed, causes, races = jax.tree.map(lambda *leaves: np.stack(leaves), *steps)
    is_over = np.any(np.stack(causes), axis=0)
    last = int(np.argmax(is_over)) if is_over.any() else len(steps) - 1
    states = np.concatenate([np.asarray(first)[None], packed[: last + 1]])
    drift = np.linalg.norm(states[:, POSITION] - reference.states[: last + 2, POSITION], axis=1)
    race = jax.tree.map(lambda leaf: leaf[last], races)
    return Replay(
        states=states,
        gates_passed=int(race.gates_passed),
        time_s=float(race.lap_time_s) if int(race.laps) else float("nan"),
        ended_by=tuple(name for name, cause in causes._asdict().items() if cause[last]),
        drift_m=float(drift.max()),
        frames_touched=_frames_touched(states[:, POSITION], params),
    )
