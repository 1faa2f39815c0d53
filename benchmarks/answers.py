"""What a log says of a drone by regression alone: no model, nothing shared with the diagnosis."""

from collections.abc import Mapping

import numpy as np

from flytrack_sysid import FlightLog

ANSWER_ROWS = 30  # 0.3 s at 100 Hz: how far back a command still acts


def answers(log: FlightLog, held_out: np.ndarray) -> tuple[Mapping[str, np.ndarray], Mapping[str, float]]:
    """Return what a step of a command leads to, by regression, and the error of that on held-out rows.

    Body rates by their own stick, rad/s per unit, and voltage by the squared thrust stick ((1 + u)/2)^2, V:
    (ANSWER_ROWS + 1,), the sum of the regression's weights up to each row. Errors: rms over the spread.
    """
    squared = ((1.0 + log["u"][:, 3]) / 2.0) ** 2
    pairs = {
        name: (log["u"][:, axis], log["w"][:, axis]) for axis, name in enumerate(("roll", "pitch", "yaw"))
    }
    pairs["voltage"] = (squared, log["v_bat"][:, 0])
    starts = np.maximum.accumulate(np.where(log.is_start(), np.arange(len(log)), 0))
    rows = np.flatnonzero(np.arange(len(log)) - starts >= ANSWER_ROWS)
    steps, errors = {}, {}
    for name, (command, measured) in pairs.items():
        past = np.stack(
            [command[rows - lag] for lag in range(ANSWER_ROWS + 1)] + [np.ones(len(rows))], axis=1
        )
        out, wanted = held_out[rows], measured[rows]
        weights = np.linalg.lstsq(past[~out], wanted[~out], rcond=None)[0]
        left = (wanted - past @ weights)[out]
        steps[name] = np.cumsum(weights[:-1])
        errors[name] = float(np.sqrt(np.mean(left**2)) / wanted[out].std())
    return steps, errors


def velocity_scale(log: FlightLog) -> tuple[float, float]:
    """Return how far a flight went over what its velocity says, horizontally and upwards, over a second.

    The geometric mean of both regressions, as either channel is noisy.
    """
    rows = round(1.0 / float(np.median(np.diff(log.time))))
    one_flight = log.segment[rows:] == log.segment[:-rows]
    said = np.cumsum(log["v"], axis=0) / rows
    moved, said = ((values[rows:] - values[:-rows])[one_flight] for values in (log["p"], said))
    horizontal = np.sum(moved[:, :2] ** 2) / np.sum(said[:, :2] ** 2)
    upward = np.sum(moved[:, 2] ** 2) / np.sum(said[:, 2] ** 2)
    return float(np.sqrt(horizontal)), float(np.sqrt(upward))
