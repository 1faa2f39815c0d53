"""The race of a recorded flight: passes, laps, the gate to fly next, and why it ended.

A rollout holds states and actions, not the race; the race follows from the positions by the
environment's own rules.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.battery import Battery
from flytrack_env.effects import ROUNDING
from flytrack_env.params import EnvParams
from flytrack_env.quaternion import Vec3
from flytrack_env.race import Race, RaceEvents, advance_race, start_race
from flytrack_env.state import BATTERY, POSITION, VELOCITY, unpack
from flytrack_env.terminations import Causes, find_causes
from flytrack_env.tracks import Course, Track, build_course, cross_gate

STEP_S = float(EnvParams.dt)
DRONE_RADIUS_M = float(EnvParams.drone_radius)
NEAR_START_M = 1.0  # starts are noisy
PADDED_TO = 1024  # steps: flights of about the same length share one compiled program


class Pass(NamedTuple):
    """One gate passed, or a lap completed by it.

    Attributes:
        row: of the first state behind the gate; the number of states if that is after the last.
        time_s: of the crossing, interpolated, s since the first state.
        gate: index in flying order.
        pos_w: where, (3,), world, m.
        lap: that it completed, counted from 1, 0 if none.
        lap_time_s: of that lap, 0.0 if none.
    """

    row: int
    time_s: float
    gate: int
    pos_w: np.ndarray
    lap: int
    lap_time_s: float


class FlownRace(NamedTuple):
    """The race at each state of a flight, leaves (T,), and its events.

    Attributes:
        gate: index of the gate to fly next.
        gate_distance_m: to its centre.
        laps: completed.
        lap_start_s: time of the crossing that began the lap.
        lap_time_s: of the last complete lap, 0 if none.
        is_frame, is_miss: whether the step from this state on touches the frame of the gate or
            misses it; for the last state only where that step is extrapolated.
        passes: in order.
    """

    gate: np.ndarray
    gate_distance_m: np.ndarray
    laps: np.ndarray
    lap_start_s: np.ndarray
    lap_time_s: np.ndarray
    is_frame: np.ndarray
    is_miss: np.ndarray
    passes: tuple[Pass, ...]


def follow_race(
    positions: np.ndarray,
    track: Track,
    first_gate: int | None = None,
    last_vel_w: np.ndarray | None = None,
) -> FlownRace:
    """Return the race of a 100 Hz flight through these positions, by ``advance_race``'s rules.

    Args:
        positions: (T, 3), world, m, finite.
        first_gate: index of the gate to fly first; if None, gate 0 for a flight that begins near
            the track's start or passes no gate, else the one that it passes first.
        last_vel_w: (3,), m/s, of the last state: a rollout ends before its last step, often just
            before a gate, and that step is extrapolated at this velocity, if it is finite.

    Raises:
        ValueError: a track without gates.
    """
    if not track.gates:
        raise ValueError("track: found no gates, expected at least one")
    course = build_course(track)
    count, positions = len(positions), np.asarray(positions, np.float32)
    if first_gate is None:
        first_gate = _first_gate(positions, track)
    if last_vel_w is not None and np.isfinite(last_vel_w).all():
        ahead_w = positions[-1] + STEP_S * np.asarray(last_vel_w, np.float32)
        positions = np.concatenate([positions, ahead_w[None]])
    num_steps = len(positions) - 1
    followed = jax.tree.map(np.asarray, _follow(_padded(positions), np.int32(first_gate), course))
    races, events, fractions = followed
    races = jax.tree.map(lambda leaf: leaf[: num_steps + 1], races)
    distances_m = np.linalg.norm(positions - np.stack(races.gate.centre, axis=-1), axis=1)
    missing = (0, count - num_steps)  # the last state's step, where it is not known
    return FlownRace(
        gate=races.gate_index[:count],
        gate_distance_m=distances_m[:count],
        laps=races.laps[:count],
        lap_start_s=races.lap_start_s[:count],
        lap_time_s=races.lap_time_s[:count],
        is_frame=np.pad(events.is_frame[:num_steps], missing),
        is_miss=np.pad(events.is_miss[:num_steps], missing),
        passes=_passes(races, fractions, positions, len(track.gates)),
    )


def _first_gate(positions: np.ndarray, track: Track) -> int:
    """Return the gate that a flight probably set out for."""
    if np.linalg.norm(positions[0] - track.start_position) < NEAR_START_M:
        return 0
    is_pass = gates_passed(positions, track)
    return int(is_pass[is_pass.any(axis=1).argmax()].argmax()) if is_pass.any() else 0


def gates_passed(positions: np.ndarray, track: Track) -> np.ndarray:
    """Return which gates each step passes in the direction of flight, whatever their order.

    Args:
        positions: (T, 3), world, m.

    Returns:
        (T - 1, num_gates) bool.
    """
    is_pass = _passed(_padded(np.asarray(positions, np.float32)), build_course(track))
    return np.asarray(is_pass)[: len(positions) - 1]


def _padded(positions: np.ndarray) -> np.ndarray:
    """Return positions (T, 3) with the last repeated, which passes no gate."""
    padding = max(1, math.ceil((len(positions) - 1) / PADDED_TO)) * PADDED_TO - len(positions) + 1
    return np.concatenate([positions, np.repeat(positions[-1:], padding, axis=0)])


def why_ended(states: np.ndarray, track: Track, race: FlownRace) -> str:
    """Return why the flight ended, as far as its last state tells.

    A rollout's last row is the state before its last step, which is extrapolated at the last
    velocity. A rollout does not state its battery: one that begins within the handout's voltages is
    taken to have the handout's, and when any other is empty is not known.

    Args:
        states: (T, 21).
        race: as ``follow_race`` returns it for them with ``last_vel_w``.
    """
    start_v, handout = float(states[0, BATTERY]), Battery()
    is_handout = handout.empty_v <= start_v <= handout.full_v * (1.0 + ROUNDING)
    battery = handout if is_handout else handout._replace(empty_v=-np.inf)
    causes = _causes(
        np.asarray(states[-1], np.float32),
        build_course(track),
        battery,
        race.is_frame[-1],
        race.is_miss[-1],
    )
    names = [name.replace("_", " ") for name, happened in causes._asdict().items() if happened]
    return ", ".join(names) or "all steps flown"


@jax.jit
def _causes(
    last: jax.Array, course: Course, battery: Battery, is_frame: jax.Array, is_miss: jax.Array
) -> Causes:
    """Return what would end the flight in the step after a state (21,)."""
    ahead_w = last[POSITION] + STEP_S * last[VELOCITY]
    ahead_w = jnp.where(jnp.isfinite(ahead_w).all(), ahead_w, last[POSITION])
    return find_causes(unpack(last.at[POSITION].set(ahead_w)), course, battery, is_frame, is_miss)


@jax.jit
def _passed(positions: jax.Array, course: Course) -> jax.Array:
    starts, ends = (Vec3(*rows.T[..., None]) for rows in (positions[:-1], positions[1:]))
    return cross_gate(course.gates, starts, ends, DRONE_RADIUS_M).is_pass


@jax.jit
def _follow(
    positions: jax.Array, first_gate: jax.Array, course: Course
) -> tuple[Race, RaceEvents, jax.Array]:
    """Return the race at each state, and the events and gate crossings of each step.

    Leaves of the race are (T,). The crossings are fractions of a step, (T - 1, 2), at the gate and
    at the one behind it.
    """

    def follow_step(race: Race, segment: tuple[jax.Array, ...]) -> tuple[Race, Any]:
        start_w, end_w = Vec3(*segment[0]), Vec3(*segment[1])
        first = cross_gate(race.gate, start_w, end_w, DRONE_RADIUS_M).fraction
        middle_w = start_w + (end_w - start_w).scale(first)
        second = cross_gate(race.next_gate, middle_w, end_w, DRONE_RADIUS_M).fraction
        fractions = jnp.stack([first, first + (1.0 - first) * second])
        start_time_s = segment[2] * STEP_S
        race, events = advance_race(
            race, start_w, end_w, start_time_s, STEP_S, course, DRONE_RADIUS_M
        )
        return race, (race, events, fractions)

    start = start_race(first_gate, course)
    indices = jnp.arange(len(positions) - 1)
    _, (races, events, fractions) = jax.lax.scan(
        follow_step, start, (positions[:-1], positions[1:], indices)
    )
    return (
        jax.tree.map(lambda first, later: jnp.concatenate([first[None], later]), start, races),
        events,
        fractions,
    )


def _passes(
    races: Race, fractions: np.ndarray, positions: np.ndarray, num_gates: int
) -> tuple[Pass, ...]:
    """Return the gates passed, in order; of two in one step each has its own time and place."""
    passes = []
    for step in np.flatnonzero(np.diff(races.gates_passed)):
        before = int(races.gates_passed[step])
        for nth in range(int(races.gates_passed[step + 1]) - before):
            fraction = float(fractions[step, nth])
            is_lap = (before + nth + 1) % num_gates == 0
            passes.append(
                Pass(
                    row=int(step) + 1,
                    time_s=(float(step) + fraction) * STEP_S,
                    gate=int((races.gate_index[step] + nth) % num_gates),
                    pos_w=positions[step] + fraction * (positions[step + 1] - positions[step]),
                    lap=int(races.laps[step + 1]) if is_lap else 0,
                    lap_time_s=float(races.lap_time_s[step + 1]) if is_lap else 0.0,
                )
            )
    return tuple(passes)
