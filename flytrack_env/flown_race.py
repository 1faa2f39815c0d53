"""The race as a recorded flight flew it: gates passed and when, laps, the gate that came next, how it ended.

A rollout holds states and actions, not the race; the race follows from the positions, by the environment's
own rules.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.quaternion import Vec3
from flytrack_env.race import Race, advance_race, start_race
from flytrack_env.state import POSITION, VELOCITY, unpack
from flytrack_env.terminations import Causes, find_causes
from flytrack_env.tracks import Course, GateFrame, Track, build_course, cross_gate

STEP_S = 0.01
DRONE_RADIUS_M = 0.15  # of ``EnvParams``
PADDED_TO = 1024  # steps: flights of about the same length share one compiled program


class Pass(NamedTuple):
    """One gate passed, or a lap completed by it.

    row: of the first state behind the gate; the number of states if that is after the last. time_s: of the
    crossing, interpolated, s since the first state. gate: index in flying order. pos_w: where, (3,), world,
    m. lap: that it completed, counted from 1, 0 if none. lap_time_s: of that lap, 0.0 if none.
    """

    row: int
    time_s: float
    gate: int
    pos_w: np.ndarray
    lap: int
    lap_time_s: float


class FlownRace(NamedTuple):
    """The race at each state of a flight, leaves (T,), and its events.

    gate: index of the gate to fly next. gate_distance_m: to its centre. laps: completed. lap_start_s: time of
    the crossing that began the lap. lap_time_s: of the last complete lap, 0 if none. passes: in order.
    """

    gate: np.ndarray
    gate_distance_m: np.ndarray
    laps: np.ndarray
    lap_start_s: np.ndarray
    lap_time_s: np.ndarray
    passes: tuple[Pass, ...]


def follow_race(
    positions: np.ndarray,
    track: Track,
    first_gate: int | None = None,
    last_vel_w: np.ndarray | None = None,
) -> FlownRace:
    """Return the race that a flight at 100 Hz through these positions was; the rules of ``advance_race``.

    positions: (T, 3), world, m, finite. first_gate: index of the gate to fly first; if None, the one that
    the flight passes first, gate 0 if it passes none. last_vel_w: (3,), m/s, of the last state: a rollout
    ends before its last step, often just before a gate, and that step is carried on at this velocity.

    Raises:
        ValueError: a track without gates.
    """
    if not track.gates:
        raise ValueError("track: found no gates, expected at least one")
    course = build_course(track)
    count, positions = len(positions), np.asarray(positions, np.float32)
    if last_vel_w is not None:
        ahead_w = positions[-1] + STEP_S * np.asarray(last_vel_w, np.float32)
        positions = np.concatenate([positions, ahead_w[None]])
    num_steps = len(positions) - 1
    if first_gate is None:
        is_pass = gates_passed(positions, track)
        first_gate = int(is_pass[is_pass.any(axis=1).argmax()].argmax()) if is_pass.any() else 0
    padded = _padded(positions)
    followed, fractions = jax.tree.map(np.asarray, _follow(padded, np.int32(first_gate), course))
    followed = _Followed(*(leaf[: num_steps + 1] for leaf in followed))
    centres = np.stack(course.gates.centre, axis=-1)[followed.gate]
    return FlownRace(
        gate=followed.gate[:count],
        gate_distance_m=np.linalg.norm(positions - centres, axis=1)[:count],
        laps=followed.laps[:count],
        lap_start_s=followed.lap_start_s[:count],
        lap_time_s=followed.lap_time_s[:count],
        passes=_passes(followed, fractions[:num_steps], positions, len(track.gates)),
    )


def gates_passed(positions: np.ndarray, track: Track) -> np.ndarray:
    """Return which gates each step passes in the direction of flight, whatever their order.

    positions: (T, 3), world, m. Returned: (T - 1, num_gates) bool.
    """
    is_pass = _passed(_padded(np.asarray(positions, np.float32)), build_course(track))
    return np.asarray(is_pass)[: len(positions) - 1]


def _padded(positions: np.ndarray) -> np.ndarray:
    """Return positions (T, 3) with the last repeated: who stands still passes nothing."""
    padding = max(1, math.ceil((len(positions) - 1) / PADDED_TO)) * PADDED_TO - len(positions) + 1
    return np.concatenate([positions, np.repeat(positions[-1:], padding, axis=0)])


def why_ended(states: np.ndarray, track: Track, race: FlownRace) -> str:
    """Return why the flight ends after its last state, as far as that state tells.

    A rollout's last row is the state before its last step; the step is carried on at the last velocity.
    states: (T, 21).
    """
    causes = _causes(np.asarray(states[-1], np.float32), np.int32(race.gate[-1]), build_course(track))
    names = [name.replace("_", " ") for name, happened in causes._asdict().items() if happened]
    return ", ".join(names) or "all steps flown"


@jax.jit
def _causes(last: jax.Array, gate_index: jax.Array, course: Course) -> Causes:
    """Return what would end the flight in the step after a state (21,)."""
    ahead_w = last[POSITION] + STEP_S * last[VELOCITY]
    gate = course.gate(gate_index)
    crossing = cross_gate(gate, Vec3(*last[POSITION]), Vec3(*ahead_w), DRONE_RADIUS_M)
    ahead = unpack(last.at[POSITION].set(ahead_w))
    return find_causes(ahead, course, crossing.is_frame, crossing.is_miss)


class _Followed(NamedTuple):
    """What is kept of the race at each state: scalars, or arrays (T,) of JAX or NumPy."""

    gate: Any
    laps: Any
    lap_start_s: Any
    lap_time_s: Any
    gates_passed: Any


def _kept(race: Race) -> _Followed:
    return _Followed(race.gate_index, race.laps, race.lap_start_s, race.lap_time_s, race.gates_passed)


@jax.jit
def _passed(positions: jax.Array, course: Course) -> jax.Array:
    def passes(gate: GateFrame, start_w: jax.Array, end_w: jax.Array) -> jax.Array:
        return cross_gate(gate, Vec3(*start_w), Vec3(*end_w), DRONE_RADIUS_M).is_pass

    of_gates = jax.vmap(passes, in_axes=(0, None, None))
    return jax.vmap(of_gates, in_axes=(None, 0, 0))(course.gates, positions[:-1], positions[1:])


@jax.jit
def _follow(positions: jax.Array, first_gate: jax.Array, course: Course) -> tuple[_Followed, jax.Array]:
    """Return the race at each state, and where between two states a gate's plane was crossed, in [0, 1]."""

    def one(race: Race, segment: tuple[jax.Array, ...]) -> tuple[Race, tuple[_Followed, jax.Array]]:
        start_w, end_w = Vec3(*segment[0]), Vec3(*segment[1])
        fraction = cross_gate(race.gate, start_w, end_w, DRONE_RADIUS_M).fraction
        start_time_s = segment[2] * STEP_S
        race, _ = advance_race(race, start_w, end_w, start_time_s, STEP_S, course, DRONE_RADIUS_M)
        return race, (_kept(race), fraction)

    begun = start_race(first_gate, course)
    steps = jnp.arange(len(positions) - 1)
    _, (followed, fractions) = jax.lax.scan(one, begun, (positions[:-1], positions[1:], steps))
    joined = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), _kept(begun), followed)
    return joined, fractions


def _passes(
    followed: _Followed, fractions: np.ndarray, positions: np.ndarray, num_gates: int
) -> tuple[Pass, ...]:
    """Return the gates passed, in order; two in one step have the first one's time and place."""
    found = []
    for row in np.flatnonzero(np.diff(followed.gates_passed)) + 1:
        fraction = float(fractions[row - 1])
        where = positions[row - 1] + fraction * (positions[row] - positions[row - 1])
        count = int(followed.gates_passed[row - 1])
        for nth in range(int(followed.gates_passed[row]) - count):
            is_lap = (count + nth + 1) % num_gates == 0
            found.append(
                Pass(
                    row=int(row),
                    time_s=float(row - 1 + fraction) * STEP_S,
                    gate=int((followed.gate[row - 1] + nth) % num_gates),
                    pos_w=where,
                    lap=int(followed.laps[row]) if is_lap else 0,
                    lap_time_s=float(followed.lap_time_s[row]) if is_lap else 0.0,
                )
            )
    return tuple(found)
