"""Trajectories of a flight log, as measured and as models fly it. Needs ``flytrack[viz]``.

The measured drone shows the specific forces that models do not explain: means over 0.1 s in the
world frame. A model flies freely under the logged commands, and restarts from a measured row every
second.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import BY_NAME
from flytrack_env.state import ACTION_SIZE, POSITION, QUATERNION, STATE_SIZE
from flytrack_env.viz_rerun import Trajectory
from flytrack_sysid.diagnosis.traces import Traces, traces
from flytrack_sysid.inference.free_flight import CHANNEL_OF, HORIZONS_S, fly_freely
from flytrack_sysid.inference.one_step import Prediction, inputs_that_lack, predict
from flytrack_sysid.inference.parameters import with_neutral_effects
from flytrack_sysid.inference.record import fill_gaps
from flytrack_sysid.kinematics import segments_of, since_first
from flytrack_sysid.log import IN_STATE, FlightLog, time_in_line

WINDOW_S = 0.1  # of means: long enough to average out noise, short against a manoeuvre
RESTART_S = 1.0  # of free flight: the horizon of the report's first sentence
FLOWN = tuple(CHANNEL_OF.values())
AWAY_M = 10.0  # from the measured path: a model that is farther away has diverged
# 1 min at 100 Hz. The path is most of a recording, and its size grows with the power 1.5 of the
# number of rows.
MAX_ROWS = 6000


class RecordingError(ValueError):
    """A log that cannot be recorded; the message names the file and channel, found and expected."""


class _Timed(NamedTuple):
    """A log with a position, and its rows on one time line.

    Attributes:
        log: the log.
        time_s: with segments one after the other, (num_rows,) s.
        every: only each n-th row is shown.
    """

    log: FlightLog
    time_s: np.ndarray
    every: int


def measure_trajectories(
    log: FlightLog, models: Mapping[str, ModelParameters], residuals: Traces | None = None
) -> list[Trajectory]:
    """Return the trajectories of a log: measured, and one of each model that can fly it.

    Of more than 6000 rows only each n-th is shown.

    Args:
        log: the flight log.
        models: by the names to show.
        residuals: of these models (``traces``); computed if None.

    Raises:
        RecordingError: the log has no rows or no attitude.
    """
    if not len(log) or "q" not in log:
        content = f"channels {', '.join(log.channels)}" if len(log) else "no rows"
        raise RecordingError(
            f"{log.source}: found {content}, expected q (attitude) to show a flight"
        )
    positions, remark = position_of(log)
    placed = replace(log, channels={**log.channels, "p": positions})
    timed = _Timed(placed, time_in_line(log), -(-len(log) // MAX_ROWS))
    if residuals is None and models:
        residuals = traces(log, models, like=next(iter(models)))
    forces_w = (
        {}
        if residuals is None
        else {name: force_w(residuals, name, timed.time_s) for name in models}
    )
    forces_w = {name: values for name, values in forces_w.items() if np.isfinite(values).any()}
    trajectories = [_measured(timed, f"measured{remark}", forces_w)]
    if "p" in log or "v" in log:
        flights = [_free_flight(timed, name, model) for name, model in models.items()]
        trajectories += [flight for flight in flights if flight is not None]
    return trajectories


def position_of(log: FlightLog) -> tuple[np.ndarray, str]:
    """Return world positions, (num_rows, 3) m, and a remark on their origin, "" if measured.

    Without measured positions, they are the integrated velocity of each segment, from 0; without a
    velocity, they are 0.
    """
    if "p" in log:
        return log["p"], ""
    if "v" not in log:
        return np.zeros((len(log), 3)), " (no position)"
    step_s = np.where(log.is_start(), 0.0, np.diff(log.time, prepend=log.time[:1]))
    path = np.cumsum(0.5 * (log["v"] + np.roll(log["v"], 1, axis=0)) * step_s[:, None], axis=0)
    return since_first(path, log.is_start()), " (position integrated)"


def states_of(channels: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return channels, (..., size), as states, (..., 21), with unit quaternions; NaN if absent."""
    states = np.full((*next(iter(channels.values())).shape[:-1], STATE_SIZE), np.nan)
    for name in IN_STATE.keys() & channels.keys():
        states[..., IN_STATE[name]] = channels[name]
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a model may diverge
        states[..., QUATERNION] /= np.linalg.norm(states[..., QUATERNION], axis=-1, keepdims=True)
    return states


def force_w(residuals: Traces, model: str, time_s: np.ndarray) -> np.ndarray:
    """Return the specific force that a model does not explain, (num_rows, 3) m/s^2, world frame.

    It is a mean over 0.1 s; NaN where no row is scored.

    Args:
        residuals: of the models.
        model: name of the model.
        time_s: time of the log's rows as of ``time_in_line``, (num_rows,) s.
    """
    force = np.full((len(time_s), 3), np.nan)
    time_s = time_s[residuals.row]
    columns, counts = zip(
        *(residuals.column(model, f"force_world_{axis}") for axis in "xyz"), strict=True
    )
    forces_and_one = np.column_stack([*columns, np.ones(len(time_s))])
    # Weighted by duration, so that only velocity noise at the ends of a window remains.
    is_scored = counts[0] & np.isfinite(forces_and_one).all(axis=1)
    weight = np.where(is_scored, np.diff(time_s, prepend=time_s[:1]), 0.0)[:, None]
    integral = np.cumsum(np.where(weight > 0.0, forces_and_one * weight, 0.0), axis=0)
    integral = np.concatenate([np.zeros((1, 4)), integral])
    begin = np.searchsorted(time_s, time_s - 0.5 * WINDOW_S)
    end = np.searchsorted(time_s, time_s + 0.5 * WINDOW_S, side="right")
    total = integral[end] - integral[begin]
    has_any = weight[:, 0] > 0.0
    force[residuals.row[has_any]] = total[has_any, :3] / total[has_any, 3:]
    return force


def _measured(timed: _Timed, name: str, residuals_w: Mapping[str, np.ndarray]) -> Trajectory:
    """Return the trajectory as it was measured."""
    log, starts = timed.log, timed.log.is_start()
    rows = np.flatnonzero(since_first(np.arange(len(log)), starts) % timed.every == 0)
    return Trajectory(
        name=name,
        states=states_of(log.channels)[rows],
        actions=log["u"][rows],
        time_s=timed.time_s[rows],
        ended="the log ends" + (f", 1 row in {timed.every} is shown" if timed.every > 1 else ""),
        restarts=starts[rows],
        residuals_w={model: forces_w[rows] for model, forces_w in residuals_w.items()},
    )


def _starts_and_ends(prediction: Prediction) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows where free flights start, one a second, and where the next ones start."""
    log, can_start = prediction.log, prediction.is_settled & prediction.is_measured
    half_step = 0.5 * prediction.step_s
    starts, ends = [np.zeros(0, int)], [np.zeros(0, int)]
    for segment in segments_of(log):
        rows = segment.start + np.flatnonzero(can_start[segment])
        if len(rows):
            wanted_s = np.arange(log.time[rows[0]], log.time[rows[-1]] + half_step, RESTART_S)
            segment_starts = rows[np.unique(np.searchsorted(log.time[rows], wanted_s - half_step))]
            starts.append(segment_starts)
            ends.append(np.append(segment_starts[1:], segment.stop))
    return np.concatenate(starts), np.concatenate(ends)


def _free_flight(timed: _Timed, name: str, model: ModelParameters) -> Trajectory | None:
    """Return a model's free flight, restarted every second; None if no row can start one."""
    model = with_neutral_effects(model, BY_NAME)  # so that one program flies all models
    if inputs_that_lack(model, timed.log)["p"]:
        return None
    filled = fill_gaps(timed.log)
    log, prediction = filled.log, predict(model, filled)
    starts, ends = _starts_and_ends(prediction)
    if not len(starts):
        return None
    steps = np.arange(1 + int(np.ceil(HORIZONS_S[-1] / prediction.step_s)))
    rows = starts[:, None] + steps
    predicted = fly_freely(model, filled, starts, len(steps) - 1)
    initial = {channel: log[channel][starts[:, None]] for channel in FLOWN if channel in log}
    states = np.concatenate([states_of(initial), states_of(predicted)], axis=1)
    is_before, rows = rows < ends[:, None], np.minimum(rows, len(log) - 1)
    with np.errstate(over="ignore", invalid="ignore"):
        away_m = np.linalg.norm(states[..., POSITION] - log["p"][rows], axis=-1)
    is_finite = np.all(
        [np.isfinite(states[..., IN_STATE[channel]]).all(axis=-1) for channel in FLOWN],
        axis=0,
    )
    is_near = is_finite & (away_m < AWAY_M)
    is_near[:, 0] = True
    num_diverged = int((is_before & ~is_near).any(axis=1).sum())
    # Measured rows until the next start, or until the model diverges.
    is_shown = (
        is_before & np.logical_and.accumulate(is_near, axis=1) & (filled.source_row[rows] >= 0)
    )
    is_shown &= steps % timed.every == 0
    shown_rows, states, restarts = (
        filled.source_row[rows[is_shown]],
        states[is_shown],
        is_shown.nonzero()[1] == 0,
    )
    if shown_rows[0] > 0:  # begin with the log's first row, so that all trajectories share a clock
        first_state = states_of(
            {channel: timed.log[channel][:1] for channel in FLOWN if channel in timed.log}
        )
        shown_rows, restarts = np.append(0, shown_rows), np.append(True, restarts)
        states = np.concatenate([first_state, states])
    return Trajectory(
        name=name,
        states=states,
        actions=np.full(
            (len(shown_rows), ACTION_SIZE), np.nan
        ),  # the same as the log's: one line would hide the other
        time_s=timed.time_s[shown_rows],
        ended=f"the log ends; anew every {RESTART_S:g} s"
        + (f"; diverged {num_diverged} times" if num_diverged else ""),
        restarts=restarts,
    )
