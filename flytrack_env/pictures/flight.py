"""A recorded flight with its race, every meeting with a gate, and why it ended."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from flytrack_env.flown_race import DRONE_RADIUS_M, STEP_S, FlownRace, Pass, follow_race, why_ended
from flytrack_env.quaternion import Vec3
from flytrack_env.rollout import load_named_rollouts
from flytrack_env.state import POSITION, VELOCITY
from flytrack_env.tracks import Track, build_course, cross_gate

PASSED, TOUCHED, MISSED = "passed", "frame touched", "missed"
SHOWN_LAPS = 6


class Meeting(NamedTuple):
    """The drone in the plane of the gate to fly next.

    Attributes:
        outcome: PASSED, TOUCHED or MISSED.
        gate: index in flying order.
        time_s: since the first state.
        distance_m: flown until then.
        pos_w: where, (3,), world, m.
        right_m, up_m: off the gate's centre, as the drone comes to it.
        speed_m_s: before it.
    """

    outcome: str
    gate: int
    time_s: float
    distance_m: float
    pos_w: np.ndarray
    right_m: float
    up_m: float
    speed_m_s: float


class Flight(NamedTuple):
    """One recorded flight at 100 Hz.

    Attributes:
        name: of its pictures.
        states: (T, 21), whose applied roll, pitch and yaw may be NaN.
        commands: (T, 4).
        race: gates and laps, followed through the positions.
        distances_m: flown until each state, (T,).
        meetings: in order.
        ended: why the flight ended.
    """

    name: str
    states: np.ndarray
    commands: np.ndarray
    track: Track
    race: FlownRace
    distances_m: np.ndarray
    meetings: tuple[Meeting, ...]
    ended: str

    @property
    def speeds_m_s(self) -> np.ndarray:
        """Speed in each state, (T,)."""
        return np.linalg.norm(self.states[:, VELOCITY], axis=1)

    @property
    def lap_times_s(self) -> list[float]:
        """Times of the complete laps, in order."""
        return [gate_pass.lap_time_s for gate_pass in self.race.passes if gate_pass.lap]

    @property
    def fastest_flying_lap(self) -> tuple[Pass, Pass] | None:
        """The passes that begin and end the fastest flying lap; None if there is none."""
        ends = [gate_pass for gate_pass in self.race.passes if gate_pass.lap]
        return min(itertools.pairwise(ends), key=lambda lap: lap[1].lap_time_s, default=None)

    @property
    def title(self) -> str:
        """Name, track, duration, gates passed and the reason of the end, in a line."""
        gates = len(self.race.passes)
        flown = f"{STEP_S * len(self.states):.2f} s, {gates} gate{'' if gates == 1 else 's'}"
        return f"{self.name} on {self.track.name}: {flown}, {self.ended}"

    @property
    def laps_text(self) -> str:
        """The lap times in a line; of many laps the first six."""
        times = self.lap_times_s
        if not times:
            return "no complete lap"
        shown = ", ".join(f"{time:.3f}" for time in times[:SHOWN_LAPS])
        return f"laps {shown} s" if len(times) <= SHOWN_LAPS else f"laps {shown}, ... s"


def make_flight(name: str, states: np.ndarray, commands: np.ndarray, track: Track) -> Flight:
    """Return the flight of states (T, 21) and commands (T, 4); positions must be finite."""
    race = follow_race(states[:, POSITION], track, last_vel_w=states[-1, VELOCITY])
    steps_m = np.linalg.norm(np.diff(states[:, POSITION].astype(float), axis=0), axis=1)
    distances_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    meetings = _meetings(states, distances_m, track, race)
    return Flight(
        name, states, commands, track, race, distances_m, meetings, why_ended(states, track, race)
    )


def read_flights(
    paths: Sequence[str | Path], track: Track, allow_pickle: bool = False
) -> tuple[Flight, ...]:
    """Return the flights of rollout files.

    They are named after the files, and their folders too where files have the same name.

    Raises:
        RolloutError: a file that is no rollout, or two files of the same name and folder's name.
    """
    rollouts = load_named_rollouts(paths, allow_pickle)
    return tuple(make_flight(name, *rollout, track) for name, rollout in rollouts.items())


def _meetings(
    states: np.ndarray, distances_m: np.ndarray, track: Track, race: FlownRace
) -> tuple[Meeting, ...]:
    """Return every crossing of the next gate's plane that passed, touched or missed it.

    The last state is extrapolated for a step at its velocity, as in ``why_ended``: most flights
    that fail meet their last gate in that step.
    """
    positions = states[:, POSITION]
    ends = np.concatenate([positions[1:], positions[-1:] + STEP_S * states[-1:, VELOCITY]])
    gates = build_course(track).gates
    of_step = jax.tree.map(lambda leaf: leaf[race.gate], gates)
    met = cross_gate(of_step, Vec3(*positions.T), Vec3(*ends.T), DRONE_RADIUS_M)
    crossings = [
        (gate_pass.row - 1, gate_pass.pos_w, gate_pass.time_s, gate_pass.gate, PASSED)
        for gate_pass in race.passes
    ]
    for outcome, is_met in ((TOUCHED, met.is_frame), (MISSED, met.is_miss)):
        for step in np.flatnonzero(is_met):
            fraction = float(met.fraction[step])
            where = positions[step] + fraction * (ends[step] - positions[step])
            crossings.append(
                (int(step), where, STEP_S * (int(step) + fraction), int(race.gate[step]), outcome)
            )

    def meeting(step: int, pos_w: np.ndarray, time_s: float, index: int, outcome: str) -> Meeting:
        gate = jax.tree.map(lambda leaf: float(leaf[index]), gates)
        off = gate.to_frame(Vec3(*pos_w.astype(float)) - gate.centre)
        return Meeting(
            outcome,
            index,
            time_s,
            distance_m=float(distances_m[step] + np.linalg.norm(pos_w - positions[step])),
            pos_w=pos_w,
            right_m=float(-off.y),
            up_m=float(off.z),
            speed_m_s=float(np.linalg.norm(states[step, VELOCITY])),
        )

    return tuple(
        meeting(*crossing) for crossing in sorted(crossings, key=lambda crossing: crossing[2])
    )
