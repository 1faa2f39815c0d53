"""A flight log as flights to be shown: as it was measured, and as models fly it. Needs ``flytrack[viz]``.

``measured`` is the log's own numbers. At its drone stand the specific forces that models leave open, means
over 0.1 s in the world frame: of the accelerometer or of known accelerations, without both of the growth of
velocity. Every model has a flight of its own: it starts at a measured row, flies by itself under the logged
commands for a second, and starts anew, so that its path leaves the measured one as fast as it is wrong.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import BY_NAME
from flytrack_env.state import ACTION_SIZE, STATE_SIZE
from flytrack_env.viz_rerun import Trajectory
from flytrack_sysid.diagnosis.traces import Traces, traces
from flytrack_sysid.forces import WINDOW_S
from flytrack_sysid.log import NOMINAL_STEP_S, FlightLog, log_of_states
from flytrack_sysid.open_loop import longest_flight
from flytrack_sysid.parameters import with_neutral_effects
from flytrack_sysid.prediction import Prediction, free_flights, inputs_that_lack, predict
from flytrack_sysid.record import Filled, fill_gaps

RESTART_S = 1.0  # of free flight: the horizon of the report's first sentence
AWAY_M = 10.0  # of the measured path: a model that is so far off has run away
BETWEEN_S = 1.0  # from the end of a segment to the start of the next
# Of one flight: 1 min at 100 Hz. Its path is most of a recording, and grows with the power 1.5 of its rows.
MOST_ROWS = 6000
FLOWN = ("p", "v", "q", "w")
_NUMBERED = np.arange(STATE_SIZE, dtype=float)[None], np.zeros((1, ACTION_SIZE))
# Where in a state each channel of a log lies.
_PLACES = {
    name: values[0].astype(int)
    for name, values in log_of_states([_NUMBERED], NOMINAL_STEP_S).channels.items()
    if name != "u"
}


class CannotShow(ValueError):
    """A log that cannot be shown; the message names the file and channel, found and expected."""


class _Timed(NamedTuple):
    """A log with a position, and its rows on one time line.

    time_s: (num_rows,) s, of segments one after the other. every: of the rows of a flight that are shown.
    """

    log: FlightLog
    time_s: np.ndarray
    every: int


class _Piece(NamedTuple):
    """Free flight from one row: the rows of a log, (n,) int, and the states there, (n, 21)."""

    rows: np.ndarray
    states: np.ndarray
    ran_away: bool


def time_in_line(log: FlightLog) -> np.ndarray:
    """Return the time of rows, (num_rows,) s from 0: segments one after the other, a second between them."""
    starts = np.flatnonzero(log.is_start())
    lengths = np.diff(np.append(starts, len(log)))
    lasts_s = log.time[starts + lengths - 1] - log.time[starts]
    begins_s = np.concatenate([[0.0], np.cumsum(lasts_s + BETWEEN_S)[:-1]])
    return log.time + np.repeat(begins_s - log.time[starts], lengths)


def position_of(log: FlightLog) -> tuple[np.ndarray, str]:
    """Return positions, (num_rows, 3) m, world, and what to know of them, "" where they were measured.

    Without them, the integrated velocity of each segment from 0 on; 0 without velocity, too.
    """
    if "p" in log:
        return log["p"], ""
    if "v" not in log:
        return np.zeros((len(log), 3)), " (no position)"
    step_s = np.where(log.is_start(), 0.0, np.diff(log.time, prepend=log.time[:1]))
    way = np.cumsum(0.5 * (log["v"] + np.roll(log["v"], 1, axis=0)) * step_s[:, None], axis=0)
    starts = np.flatnonzero(log.is_start())
    return way - way[starts][np.cumsum(log.is_start()) - 1], " (position integrated)"


def states_of(channels: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return channels of a log as states with unit quaternions, (num_rows, 21); NaN where one is absent."""
    states = np.full((len(next(iter(channels.values()))), STATE_SIZE), np.nan)
    for name in _PLACES.keys() & channels.keys():
        states[:, _PLACES[name]] = channels[name]
    quats = states[:, _PLACES["q"]]
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a model may run away
        states[:, _PLACES["q"]] = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return states


def open_force_w(left: Traces, model: str, time_s: np.ndarray) -> np.ndarray:
    """Return the specific force that a model leaves open, (num_rows, 3) m/s^2, world, means over 0.1 s.

    NaN where nothing is judged. time_s: (num_rows,), as of ``time_in_line``.
    """
    columns, counts = zip(*(left.column(model, f"force_world_{axis}") for axis in "xyz"), strict=True)
    parts = np.column_stack([*columns, np.ones(len(time_s))])
    # By duration, so that the noise of velocities cancels between the ends of a window.
    is_judged = counts[0] & np.isfinite(parts).all(axis=1)
    weight = np.where(is_judged, np.diff(time_s, prepend=time_s[:1]), 0.0)
    summed = np.cumsum(np.where(weight[:, None] > 0.0, parts * weight[:, None], 0.0), axis=0)
    summed = np.concatenate([np.zeros((1, 4)), summed])
    begin = np.searchsorted(time_s, time_s - 0.5 * WINDOW_S)
    end = np.searchsorted(time_s, time_s + 0.5 * WINDOW_S, side="right")
    total = summed[end] - summed[begin]
    counted = weight[:, None] > 0.0
    return np.divide(total[:, :3], total[:, 3:], out=np.full((len(total), 3), np.nan), where=counted)


def measured_flight(timed: _Timed, name: str, residuals_w: Mapping[str, np.ndarray]) -> Trajectory:
    """Return the flight as it was measured."""
    log, starts = timed.log, timed.log.is_start()
    first = np.flatnonzero(starts)[np.cumsum(starts) - 1]
    rows = np.flatnonzero((np.arange(len(log)) - first) % timed.every == 0)
    return Trajectory(
        name=name,
        states=states_of(log.channels)[rows],
        actions=log["u"][rows],
        time_s=timed.time_s[rows],
        ended="the log ends" + (f", 1 row in {timed.every} is shown" if timed.every > 1 else ""),
        restarts=starts[rows],
        residuals_w={model: forces_w[rows] for model, forces_w in residuals_w.items()},
    )


def _starts_and_ends(filled: Filled, prediction: Prediction) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows that free flights start from, one a second, and those where the next one takes over."""
    log, able = filled.log, prediction.is_settled & prediction.steps.is_measured
    half_step = 0.5 * prediction.steps.median
    edges = np.append(np.flatnonzero(log.is_start()), len(log))
    starts, ends = [], []
    for first, end in pairwise(edges):
        rows = first + np.flatnonzero(able[first:end])
        if len(rows):
            wanted = np.arange(log.time[rows[0]], log.time[rows[-1]] + half_step, RESTART_S)
            own = rows[np.unique(np.searchsorted(log.time[rows], wanted - half_step))]
            starts.append(own)
            ends.append(np.append(own[1:], end))
    nothing = [np.zeros(0, int)]
    return np.concatenate(starts or nothing), np.concatenate(ends or nothing)


def _piece(filled: Filled, start: int, end: int, flown: Mapping[str, np.ndarray], every: int) -> _Piece:
    """Return what is shown of one free flight: measured rows before ``end``, until it runs away.

    flown: p, v, q, w at the rows after the start, (num_steps, size).
    """
    rows = start + np.arange(min(end - start, 1 + len(flown["p"])))
    measured = {name: filled.log[name][start : start + 1] for name in FLOWN if name in filled.log}
    states = np.concatenate(
        [states_of(measured), states_of({name: flown[name][: len(rows) - 1] for name in FLOWN})]
    )
    with np.errstate(over="ignore", invalid="ignore"):
        away = np.linalg.norm(states[:, _PLACES["p"]] - filled.log["p"][rows], axis=1)
    seen = np.concatenate([_PLACES[name] for name in FLOWN])
    is_sound = np.isfinite(states[:, seen]).all(axis=1) & (away < AWAY_M)
    is_sound[0] = True
    count = len(rows) if is_sound.all() else int(np.argmin(is_sound))
    shown = np.flatnonzero(filled.source_row[rows[:count]] >= 0)
    shown = shown[shown % every == 0]
    return _Piece(filled.source_row[rows[shown]], states[shown], count < len(rows))


def model_flight(timed: _Timed, name: str, model: ModelParameters) -> Trajectory | None:
    """Return a model's free flight, anew every second; None where the log lacks what it starts from."""
    model = with_neutral_effects(model, BY_NAME)  # so that one program flies every one
    if inputs_that_lack(model, timed.log)["p"]:
        return None
    filled = fill_gaps(timed.log)
    prediction = predict(model, filled)
    starts, ends = _starts_and_ends(filled, prediction)
    pieces: list[_Piece] = []
    for batch, flown in free_flights(model, filled.log, prediction, starts, longest_flight(prediction)):
        own = ends[len(pieces) : len(pieces) + len(batch)]
        for number, (start, end) in enumerate(zip(batch, own, strict=True)):
            one = {channel: values[number] for channel, values in flown.items()}
            pieces.append(_piece(filled, start, end, one, timed.every))
    if not pieces:
        return None
    return _joined(timed, name, pieces)


def _joined(timed: _Timed, name: str, pieces: list[_Piece]) -> Trajectory:
    """Return pieces as one flight; it begins with the log's first row, so that all flights have one clock."""
    if pieces[0].rows[0] > 0:
        first = states_of({channel: timed.log[channel][:1] for channel in FLOWN if channel in timed.log})
        pieces = [_Piece(np.zeros(1, int), first, False), *pieces]
    rows = np.concatenate([piece.rows for piece in pieces])
    restarts = np.concatenate([np.arange(len(piece.rows)) == 0 for piece in pieces])
    ran_away = sum(piece.ran_away for piece in pieces)
    astray = f"; ran away {ran_away} times" if ran_away else ""
    return Trajectory(
        name=name,
        states=np.concatenate([piece.states for piece in pieces]),
        actions=np.full((len(rows), ACTION_SIZE), np.nan),  # those of the log: one line would hide another
        time_s=timed.time_s[rows],
        ended=f"the log ends; anew every {RESTART_S:g} s{astray}",
        restarts=restarts,
    )


def flights_of(
    log: FlightLog, models: Mapping[str, ModelParameters], left: Traces | None = None
) -> list[Trajectory]:
    """Return the flights of a log that are to be shown: measured, and one of each model that can fly it.

    models: by the names to show. left: what they leave of the log (``traces``), if that is known. Of more
    than 6000 rows every n-th is shown.

    Raises:
        CannotShow: a log without rows or without attitude.
    """
    if not len(log) or "q" not in log:
        found = f"channels {', '.join(log.channels)}" if len(log) else "no rows"
        raise CannotShow(f"{log.source}: found {found}, expected q (attitude) to show a flight")
    positions, remark = position_of(log)
    placed = replace(log, channels={**log.channels, "p": positions})
    timed = _Timed(placed, time_in_line(log), -(-len(log) // MOST_ROWS))
    if left is None and models:
        left = traces(log, models, like=next(iter(models)))
    forces_w = {} if left is None else {name: open_force_w(left, name, timed.time_s) for name in models}
    forces_w = {name: one for name, one in forces_w.items() if np.isfinite(one).any()}
    flights = [measured_flight(timed, f"measured{remark}", forces_w)]
    if "p" in log or "v" in log:
        flown = [model_flight(timed, name, model) for name, model in models.items()]
        flights += [one for one in flown if one is not None]
    return flights
