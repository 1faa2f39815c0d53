"""Responses to the largest commanded steps of a log, measured and modelled."""

from typing import NamedTuple

import numpy as np

from flytrack_sysid.inference.free_flight import fly_freely
from flytrack_sysid.inference.one_step import Prediction
from flytrack_sysid.kinematics import runs_of

AXES = ("roll", "pitch", "yaw")
MIN_JUMP = 0.2
HELD_BEFORE_S = 0.08
HELD_AFTER_S = 0.15
CONSTANT_WITHIN = 1e-3  # of a stick in [-1, 1]: finer than a receiver's steps
SHOWN_BEFORE_S = 0.1
SHOWN_AFTER_S = 0.4
MAX_PER_AXIS = 3
TIME_ROUNDING_S = 1e-6


class StepResponse(NamedTuple):
    """One commanded step: the body rate as measured, and as modelled in free flight.

    The free flight starts before the step.

    Attributes:
        axis: roll, pitch or yaw.
        segment: segment of the log.
        time_s: time of the step in the log (s).
        command_before: command before the step, in [-1, 1].
        command_after: command after the step, in [-1, 1].
        since_step: time since the step (s), (num_rows,).
        command: commands, (num_rows,).
        measured: measured body rate (rad/s), (num_rows,).
        modelled: modelled body rate (rad/s), (num_rows,).
        rms: RMS of their difference (rad/s).
    """

    axis: str
    segment: int
    time_s: float
    command_before: float
    command_after: float
    since_step: np.ndarray
    command: np.ndarray
    measured: np.ndarray
    modelled: np.ndarray
    rms: float


def _steps_in(time: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Return the rows of one run where a command jumps between two constant values."""
    changes = np.flatnonzero(np.abs(np.diff(command)) > CONSTANT_WITHIN) + 1
    times = time[np.concatenate([[0], changes])]
    held_before = np.diff(times)
    held_after = np.append(times[2:], time[-1])[: len(changes)] - time[changes]
    is_step = np.abs(command[changes] - command[changes - 1]) >= MIN_JUMP
    is_step &= held_before >= HELD_BEFORE_S - TIME_ROUNDING_S
    is_step &= held_after >= HELD_AFTER_S - TIME_ROUNDING_S
    return changes[is_step]


def _largest_steps(
    prediction: Prediction, rows: np.ndarray, axis: int
) -> list[tuple[int, int, int]]:
    """Return the largest steps of an axis: first shown row, row of the step, end of shown rows."""
    largest, log = [], prediction.log
    command = log["u"][:, axis]
    for start, end in runs_of(rows, prediction.record.begins):
        time = log.time[start:end]
        for step in _steps_in(time, command[start:end]).tolist():
            step_time = time[step]
            first = int(np.searchsorted(time, step_time - SHOWN_BEFORE_S - TIME_ROUNDING_S))
            last = int(np.searchsorted(time, step_time + SHOWN_AFTER_S + TIME_ROUNDING_S))
            is_whole = time[0] <= step_time - SHOWN_BEFORE_S + TIME_ROUNDING_S
            if is_whole and prediction.is_settled[start + first]:
                largest.append((start + first, start + step, start + last))
    largest.sort(key=lambda rows: -abs(command[rows[1]] - command[rows[1] - 1]))
    return largest[:MAX_PER_AXIS]


def step_responses(prediction: Prediction, rows: np.ndarray) -> tuple[StepResponse, ...]:
    """Return the responses to the largest commanded steps of each rate axis.

    A step is a jump by at least 0.2 between commands that are constant for 0.08 s before and 0.15 s
    after it.

    Args:
        prediction: steps from every row.
        rows: rows that are scored, (num_rows,) bool.
    """
    log = prediction.log
    if "w" not in log:
        return ()
    shown = [
        (axis, *step_rows)
        for axis in range(len(AXES))
        for step_rows in _largest_steps(prediction, rows, axis)
    ]
    if not shown:
        return ()
    firsts, ends = np.array([(first, end) for _, first, _, end in shown]).T
    flights = fly_freely(prediction.model, prediction.filled, firsts, int(max(ends - firsts)) - 1)
    responses = []
    for (axis, first, step, end), rates in zip(shown, flights["w"], strict=True):
        shown_rows = slice(first + 1, end)
        measured, modelled = log["w"][shown_rows, axis], rates[: end - first - 1, axis]
        responses.append(
            StepResponse(
                axis=AXES[axis],
                segment=int(log.segment[step]),
                time_s=float(log.time[step]),
                command_before=float(log["u"][step - 1, axis]) + 0.0,  # no -0
                command_after=float(log["u"][step, axis]) + 0.0,
                since_step=log.time[shown_rows] - log.time[step],
                command=log["u"][shown_rows, axis],
                measured=measured,
                modelled=modelled,
                rms=float(np.sqrt(np.mean((measured - modelled) ** 2))),
            )
        )
    return tuple(responses)
