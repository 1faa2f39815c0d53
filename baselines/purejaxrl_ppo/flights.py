"""What is known of flights: every step of them, or what came of them; and their score."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from flytrack_env.rollout import save_rollout
from flytrack_env.state import POSITION
from flytrack_env.terminations import Causes


class Flight(NamedTuple):
    """One episode; leaves (num_steps, ...), or (num_episodes, num_steps, ...) for many.

    states: (21,) before the step. actions: (4,), clipped as commanded. is_flying: whether the step was
    flown; what follows the end is padding. gates_passed, laps, lap_completed, lap_time_s: after the
    step. gate_time_s: of the gate passed in the step, s since the reset, interpolated; 0 without one. Two
    gates in one step have the first one's. causes: of termination, in the step that ended the episode.
    """

    states: jax.Array
    actions: jax.Array
    is_flying: jax.Array
    gates_passed: jax.Array
    laps: jax.Array
    lap_completed: jax.Array
    lap_time_s: jax.Array
    gate_time_s: jax.Array
    causes: Causes

    def positions(self) -> np.ndarray:
        """Return every position flown through, (num_samples, 3), world, m."""
        return np.asarray(self.states)[np.asarray(self.is_flying)][:, POSITION]


class Outcomes(NamedTuple):
    """What came of flights; leaves (num_flights, ...), or without the first axis for one.

    steps: flown. gates_passed, laps: numbers. lap_times_s: (num_laps,), the first from standstill;
    gate_times_s: (num_laps * num_gates,), s since the reset; both NaN for what was not reached. causes: of
    termination.
    """

    steps: Any
    gates_passed: Any
    laps: Any
    lap_times_s: Any
    gate_times_s: Any
    causes: Causes

    def is_complete(self) -> np.ndarray:
        """Return which flights completed their laps, (num_flights,)."""
        return np.asarray(self.laps) >= np.shape(self.lap_times_s)[-1]

    def first_laps_s(self) -> np.ndarray:
        """Return the times of the first laps that were completed, from standstill, s, (number of these,)."""
        times = np.asarray(self.lap_times_s)[..., 0]
        return times[np.isfinite(times)]

    def flying_laps_s(self) -> np.ndarray:
        """Return the times of all later laps that were completed, s, (number of these,)."""
        times = np.asarray(self.lap_times_s)[..., 1:]
        return times[np.isfinite(times)]

    def ends(self) -> dict[str, np.ndarray]:
        """Return which flights each cause ended before their laps were complete, and the time limit.

        Masks (num_flights,).
        """
        is_complete = self.is_complete()
        causes = {name: np.asarray(cause) & ~is_complete for name, cause in self.causes._asdict().items()}
        is_ended = np.any(list(causes.values()), axis=0)
        return {**causes, "time_limit": ~is_complete & ~is_ended}


class Score(NamedTuple):
    """Result of many episodes.

    success: share that completed the laps. gates: mean number passed. first_lap_s, flying_lap_s: mean
    time of the first lap, from standstill, and of the later ones; NaN where there was none.
    """

    success: float
    gates: float
    first_lap_s: float
    flying_lap_s: float


def outcomes_of(flights: Flight, num_laps: int, num_gates: int) -> Outcomes:
    """Return what came of flights whose every step is known, leaves (num_flights, num_steps, ...).

    num_gates: of a lap.
    """
    flights = jax.tree.map(np.asarray, flights)
    before = np.pad(flights.gates_passed[:, :-1], ((0, 0), (1, 0)))
    lap_times_s = np.full((len(before), num_laps), np.nan, np.float32)
    gate_times_s = np.full((len(before), num_laps * num_gates), np.nan, np.float32)

    def put(times_s: np.ndarray, is_event: Any, places: Any, values: Any) -> None:  # NumPy's, of a Flight
        where = is_event & (places < times_s.shape[1])
        times_s[np.nonzero(where)[0], places[where]] = values[where]

    put(lap_times_s, flights.lap_completed, flights.laps - 1, flights.lap_time_s)
    for place in (before, before + 1):  # two gates can be passed in one step
        put(gate_times_s, place < flights.gates_passed, place, flights.gate_time_s)
    return Outcomes(
        steps=flights.is_flying.sum(axis=1),
        gates_passed=flights.gates_passed.max(axis=1),
        laps=flights.laps.max(axis=1),
        lap_times_s=lap_times_s,
        gate_times_s=gate_times_s,
        causes=Causes(*(cause.any(axis=1) for cause in flights.causes)),
    )


def save_flown(path: Path, flight: Flight) -> None:
    """Write the steps that were flown of one flight as a rollout file."""
    is_flying = np.asarray(flight.is_flying)
    save_rollout(path, np.asarray(flight.states)[is_flying], np.asarray(flight.actions)[is_flying])


def score(outcomes: Outcomes) -> Score:
    """Return the score of many flights."""

    def mean(times_s: np.ndarray) -> float:
        return float(times_s.mean()) if times_s.size else float("nan")

    return Score(
        success=float(outcomes.is_complete().mean()),
        gates=float(outcomes.gates_passed.mean()),
        first_lap_s=mean(outcomes.first_laps_s()),
        flying_lap_s=mean(outcomes.flying_laps_s()),
    )
