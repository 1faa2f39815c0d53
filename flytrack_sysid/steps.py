"""Responses to the largest commanded steps of a log, measured and modelled."""

from typing import NamedTuple

import numpy as np

from flytrack_sysid.prediction import Prediction, free_flights, runs_of

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

    time_s, segment: where in the log. command_before, command_after: in [-1, 1]. since_step:
    (num_rows,) s. command: (num_rows,). measured, modelled: (num_rows,) rad/s. rms: of their
    difference, rad/s.
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
    """Return the largest steps of an axis: first row shown, row of the step, end of shown rows."""
    found, log = [], prediction.log
    command = log["u"][:, axis]
    for start, end in runs_of(rows, prediction.record):
        time = log.time[start:end]
        for step in _steps_in(time, command[start:end]).tolist():
            at = time[step]
            first = int(np.searchsorted(time, at - SHOWN_BEFORE_S - TIME_ROUNDING_S))
            last = int(np.searchsorted(time, at + SHOWN_AFTER_S + TIME_ROUNDING_S))
            is_whole = time[0] <= at - SHOWN_BEFORE_S + TIME_ROUNDING_S
            if is_whole and prediction.is_settled[start + first]:
                found.append((start + first, start + step, start + last))
    found.sort(key=lambda rows: -abs(command[rows[1]] - command[rows[1] - 1]))
    return found[:MAX_PER_AXIS]


def step_responses(prediction: Prediction, rows: np.ndarray) -> tuple[StepResponse, ...]:
    """Return the responses to the largest commanded steps of each rate axis.

    rows: (num_rows,) bool, the judged ones. A step is a jump by at least 0.2 between commands that
    are constant for 0.08 s before and 0.15 s after it.
    """
    log = prediction.log
    if "w" not in log:
        return ()
    shown = [
        (axis, *place)
        for axis in range(len(AXES))
        for place in _largest_steps(prediction, rows, axis)
    ]
    firsts, ends = np.array([(first, end) for _, first, _, end in shown], int).reshape(-1, 2).T
    since_first = np.arange(1, np.max(ends - firsts, initial=1))
    flown = free_flights(prediction, firsts, firsts[:, None] + since_first)
    responses = []
    for (axis, first, step, end), rates in zip(shown, flown["w"], strict=True):
        since = slice(first + 1, end)
        measured, modelled = log["w"][since, axis], rates[: end - first - 1, axis]
        responses.append(
            StepResponse(
                axis=AXES[axis],
                segment=int(log.segment[step]),
                time_s=float(log.time[step]),
                command_before=float(log["u"][step - 1, axis]) + 0.0,  # no -0
                command_after=float(log["u"][step, axis]) + 0.0,
                since_step=log.time[since] - log.time[step],
                command=log["u"][since, axis],
                measured=measured,
                modelled=modelled,
                rms=float(np.sqrt(np.mean((measured - modelled) ** 2))),
            )
        )
    return tuple(responses)
