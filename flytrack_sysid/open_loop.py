"""How far a model drifts from the measured flight when it flies by itself."""

from typing import Any, NamedTuple

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.log import FlightLog
from flytrack_sysid.prediction import (
    Prediction,
    free_flights,
    inputs_that_lack,
    runs_of,
    turn_between,
)

HORIZONS_S = (0.1, 0.5, 1.0, 2.0)
START_EVERY_S = 0.25
# Channel of each error, and its unit.
QUANTITIES = {
    "position": ("p", "m"),
    "velocity": ("v", "m/s"),
    "attitude": ("q", "deg"),
    "rates": ("w", "rad/s"),
}
HIGH_PERCENTILE = 95.0


class Spread(NamedTuple):
    """Size of an error over all starts."""

    median: float
    rms: float
    p95: float


class Rollout(NamedTuple):
    """Errors at one horizon; ``errors`` is empty where there is no start."""

    horizon_s: float
    num_starts: int
    errors: dict[str, Spread]

    def as_json(self) -> dict[str, Any]:
        """Return the numbers as JSON values."""
        errors = {
            f"{name}_{QUANTITIES[name][1].replace('/', '_per_')}": spread._asdict()
            for name, spread in self.errors.items()
        }
        return {"horizon_s": self.horizon_s, "starts": self.num_starts, **errors}


def _starts_and_ends(
    log: FlightLog, prediction: Prediction, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows to start from, (num_starts,), and those at the horizons, (num_starts, num_horizons).

    An end is the row nearest to its horizon; -1 where the judged run ends before.
    """
    starts, ends = [], []
    half_step = 0.5 * prediction.steps.median
    for first, end in runs_of(rows, prediction.steps):
        time, is_settled = log.time[first:end], prediction.is_settled[first:end]
        if not is_settled.any():
            continue
        wanted = np.arange(time[np.argmax(is_settled)], time[-1], START_EVERY_S)
        begin = np.searchsorted(time, wanted - half_step)
        begin = begin[prediction.steps.is_measured[first + begin]]
        reached = np.searchsorted(time, time[begin, None] + np.array(HORIZONS_S) - half_step)
        last = np.minimum(first + reached, len(log) - 1)
        starts.append(first + begin)
        ends.append(np.where((reached < len(time)) & prediction.steps.is_measured[last], last, -1))
    if not starts:
        return np.zeros(0, int), np.zeros((0, len(HORIZONS_S)), int)
    return np.concatenate(starts), np.concatenate(ends)


def longest_flight(prediction: Prediction) -> int:
    """Return the number of steps that free flights are padded to: the longest horizon."""
    return int(np.ceil(HORIZONS_S[-1] / prediction.steps.median))


def _distance(channel: str, measured: np.ndarray, flown: np.ndarray) -> np.ndarray:
    """Return the size of the difference, unit of the quantity; (num_starts, size) -> (num_starts,)."""
    if channel == "q":
        return np.rad2deg(np.linalg.norm(turn_between(measured, flown), axis=1))
    return np.linalg.norm(measured - flown, axis=1)


def _spread(distances: np.ndarray) -> Spread:
    with np.errstate(over="ignore", invalid="ignore"):
        rms = float(np.sqrt(np.mean(distances**2)))
        median, high = np.percentile(distances, [50.0, HIGH_PERCENTILE]).tolist()
    return Spread(median, rms, high)


def rollout_errors(
    model: ModelParameters, log: FlightLog, prediction: Prediction, rows: np.ndarray
) -> tuple[Rollout, ...]:
    """Return the errors of free flights from measured states, a start every 0.25 s of judged runs.

    rows: (num_rows,) bool, those judged; a flight stays in them, and begins and ends where it was measured.
    """
    lacking = inputs_that_lack(model, log)
    judged = [name for name, (channel, _) in QUANTITIES.items() if channel in log and not lacking[channel]]
    starts, ends = _starts_and_ends(log, prediction, rows)
    starts, ends = starts[(ends >= 0).any(axis=1)], ends[(ends >= 0).any(axis=1)]
    num_steps = max([longest_flight(prediction), *(ends - starts[:, None]).max(axis=1, initial=0)])
    found: dict[tuple[int, str], list[np.ndarray]] = {}
    done = 0
    for batch, flown in free_flights(model, log, prediction, starts, num_steps):
        for index in range(len(HORIZONS_S)):
            last = ends[done : done + len(batch), index]
            reaches = np.flatnonzero(last >= 0)
            for name in judged:
                channel = QUANTITIES[name][0]
                at_end = flown[channel][reaches, last[reaches] - batch[reaches] - 1]
                with np.errstate(over="ignore", invalid="ignore"):  # a model may run away
                    distances = _distance(channel, log[channel][last[reaches]], at_end)
                found.setdefault((index, name), []).append(distances)
        done += len(batch)
    rollouts = []
    for index, horizon_s in enumerate(HORIZONS_S):
        count = int(np.sum(ends[:, index] >= 0))
        errors = {name: _spread(np.concatenate(found[index, name])) for name in judged} if count else {}
        rollouts.append(Rollout(horizon_s, count, errors))
    return tuple(rollouts)
