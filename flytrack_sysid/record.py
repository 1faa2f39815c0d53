"""A log made ready for replay: on even steps, gaps filled with rows that count for nothing.

Commands are what a replay is driven by, so a lost row matters twice: its measurements are missing,
and so is the command that was given in it. Filled rows get commands in between their neighbours,
and how far off those may be is carried along (``command_doubt``), so that rows where it matters can
be left out.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.state import ACTION_SIZE
from flytrack_sysid.log import GAP_STEPS, FlightLog, time_in_line, usual_step
from flytrack_sysid.log_voltage import assumed_voltage
from flytrack_sysid.resample import interpolate, interpolate_quaternions
from flytrack_sysid.split import blocks_of, cut_evenly

MAX_FILLED_S = 0.1  # after a longer gap a new flight begins
# Without voltage thrust is off by another share in each flight, and the velocity runs away with it.
WINDOW_WITHOUT_VOLTAGE_S = 1.25
WINDOW_S = 2.5  # over which increments of velocity and attitude are followed
PADDED_TO = 1024  # rows: logs of about the same length share one compiled program
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
# An applied action known worse than this counts for nothing: half a gyro's noise at full stick.
MAX_DOUBT = 0.005
APPLIED_UNKNOWN = 1.0  # standard deviation of an applied action that nothing is known of


class Record(NamedTuple):
    """Rows of a replay, padded; row k is followed by row k + 1 after ``step_s``.

    source_row: (num_rows,) int, the log's row, -1 for filled ones and padding. step_s: (num_rows,)
    s. command: (num_rows, 4). command_doubt: (num_rows, 4), how far off the command may be
    (standard deviation). begins: (num_rows,) bool, a flight starts here. is_applied_known:
    (num_rows,) bool, ``applied`` was measured here. applied: (num_rows, 4). pos_w, vel_w:
    (num_rows, 3). quat: (num_rows, 4). battery_v: (num_rows,). Where a channel is absent: 0,
    upright, ``assumed_voltage``. piece: (num_rows,) int, numbers of stretches of at most 2.5 s,
    none across blocks. time_s: (num_rows,) s, since the log began, of several each.
    """

    source_row: np.ndarray
    step_s: np.ndarray
    command: np.ndarray
    command_doubt: np.ndarray
    begins: np.ndarray
    is_applied_known: np.ndarray
    applied: np.ndarray
    pos_w: np.ndarray
    vel_w: np.ndarray
    quat: np.ndarray
    battery_v: np.ndarray
    piece: np.ndarray
    time_s: np.ndarray


def _new_times(log: FlightLog, usual: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times with gaps filled, the log's row at or before each, and where a flight begins."""
    steps = np.diff(log.time, append=log.time[-1])
    ends = np.append(log.segment[1:] != log.segment[:-1], True)
    is_long = ~ends & (steps > MAX_FILLED_S)
    is_gap = ~ends & ~is_long & (steps > GAP_STEPS * usual)
    pieces = np.where(is_gap, np.round(steps / usual).astype(int), 1)
    pieces = np.maximum(pieces, 1)
    row = np.repeat(np.arange(len(log)), pieces)
    part = np.arange(len(row)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    times = log.time[row] + part * (steps / pieces)[row]
    begins = (part == 0) & np.append(True, (ends | is_long)[:-1])[row]
    return times, np.where(part == 0, row, -1 - row), begins


def _doubts(log: FlightLog, pieces: np.ndarray) -> np.ndarray:
    """Return how far a command in the gap after each row may be off, (num_rows, 4).

    A command that changes evenly is off by nothing, one that jumps somewhere in the gap by half the
    jump.
    """
    change = np.diff(log["u"], axis=0, append=log["u"][-1:])
    # To the next row of the same flight, per step; the last row of a flight has none.
    has_next = ~np.append(log.is_start()[1:], True)[:, None]
    slope = np.where(has_next, change / pieces[:, None], 0.0)
    sides = np.roll(has_next, 1, axis=0).astype(int) + np.roll(has_next, -1, axis=0)
    mean = (np.roll(slope, 1, axis=0) + np.roll(slope, -1, axis=0)) / np.maximum(sides, 1)
    expected = mean * pieces[:, None]
    return 0.5 * np.abs(change - expected)


def _velocity(log: FlightLog) -> np.ndarray:
    """Return the velocity, or what positions say of it; 0 without either."""
    if "v" in log:
        return log["v"]
    velocity = np.zeros((len(log), 3))
    starts = np.flatnonzero(log.is_start())
    for start, end in zip(starts, np.append(starts[1:], len(log)), strict=True):
        if "p" in log and end - start > 1:
            velocity[start:end] = np.gradient(log["p"][start:end], log.time[start:end], axis=0)
    return velocity


class Filled(NamedTuple):
    """A log with rows added in its gaps, in between their neighbours.

    log: segments end where a gap is too long to be filled. source_row: (num_rows,) int, the row of
    the log as it was; -1 for added ones. behind: (num_rows,) int, that row or the one before the
    gap. command_doubt: (num_rows, 4), standard deviation of how far a command may be off.
    """

    log: FlightLog
    source_row: np.ndarray
    behind: np.ndarray
    command_doubt: np.ndarray


def fill_gaps(log: FlightLog) -> Filled:
    """Return a log without gaps."""
    usual = usual_step(log)
    in_line = replace(log, time=time_in_line(log, usual[log.is_start()]))
    times, rows, begins = _new_times(in_line, usual)
    measured = rows >= 0
    behind = np.where(measured, rows, -1 - rows)
    pieces = np.bincount(behind, minlength=len(log))
    channels = {}
    for name, values in log.channels.items():
        between = interpolate_quaternions if name == "q" else interpolate
        channels[name], _ = between(in_line.time, values, times)
        channels[name][measured] = values[rows[measured]]
    filled = replace(
        log,
        time=times - (in_line.time - log.time)[behind],
        channels=channels,
        segment=np.cumsum(begins) - 1,
    )
    doubt = np.where(measured[:, None], 0.0, _doubts(log, pieces)[behind])
    return Filled(filled, np.where(measured, rows, -1), behind, doubt)


def record_of(filled: Filled) -> Record:
    """Return a log without gaps as a record, without padding and in one piece."""
    log, begins = filled.log, filled.log.is_start()
    zeros = np.zeros((len(log), 3))
    is_first_row = np.append(True, np.diff(log.time) < 0.0)  # of several logs as one
    after_gap = np.append(False, filled.source_row[:-1] < 0) & (filled.source_row >= 0)
    return Record(
        source_row=filled.source_row,
        # To the next row of the flight; the usual step at its end.
        step_s=np.where(
            np.append(begins[1:], True), usual_step(log), np.diff(log.time, append=log.time[-1])
        ),
        command=log["u"],
        command_doubt=filled.command_doubt,
        begins=begins,
        is_applied_known=(begins | after_gap) & ("uprev" in log),
        applied=log["uprev"] if "uprev" in log else log["u"],
        pos_w=log.channels.get("p", zeros),
        vel_w=_velocity(log),
        quat=log["q"] if "q" in log else np.tile(UPRIGHT, (len(log), 1)),
        battery_v=log["v_bat"][:, 0] if "v_bat" in log else zeros[:, 0] + assumed_voltage(log),
        piece=np.zeros(len(log), int),
        time_s=log.time - log.time[np.flatnonzero(is_first_row)][np.cumsum(is_first_row) - 1],
    )


def make_record(log: FlightLog) -> Record:
    """Return a log ready for replay."""
    filled = fill_gaps(log)
    record = record_of(filled)
    longest_s = WINDOW_S if "v_bat" in log else WINDOW_WITHOUT_VOLTAGE_S
    is_first = record.begins | np.append(True, np.diff(blocks_of(log)[filled.behind]) != 0)
    return _padded(record._replace(piece=cut_evenly(filled.log.time, is_first, longest_s)))


def _padded(record: Record) -> Record:
    """Return the record with rows added that start nothing and count for nothing."""
    missing = -len(record.source_row) % PADDED_TO

    def pad(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, np.repeat(values[-1:], missing, axis=0)])

    padded = Record(*(pad(values) for values in record))
    source_row, begins = padded.source_row.copy(), padded.begins.copy()
    if missing:
        source_row[-missing:], begins[-missing:] = -1, True
    return padded._replace(source_row=source_row, begins=begins)


def is_applied_certain(record: Record, tau: np.ndarray) -> np.ndarray:
    """Return where a replay's applied action is known well enough to judge by, (num_rows, 4).

    Doubt is from commands that were lost and from what was applied when a flight began; both are
    forgotten with the lags ``tau``, (4,) s.
    """
    keep = np.exp(-record.step_s[:, None] / tau)
    enters = (1.0 - keep) ** 2 * record.command_doubt**2
    unknown = np.where(record.is_applied_known, 0.0, APPLIED_UNKNOWN**2)
    variance, variances = np.full(ACTION_SIZE, unknown[0]), np.empty_like(record.command_doubt)
    restarts = record.begins | record.is_applied_known
    for row in range(len(restarts)):
        if restarts[row]:
            variance = np.full(ACTION_SIZE, unknown[row])
        variances[row] = variance
        variance = keep[row] ** 2 * variance + enters[row]
    return np.sqrt(variances) < MAX_DOUBT


def measured_channels(log: FlightLog, record: Record, gravity: float) -> dict[str, np.ndarray]:
    """Return what a log measured on the record's rows, by channel; anything in filled rows.

    ``f`` comes from ``a`` where there is no accelerometer, ``p`` only without ``v``. Without ``q``
    nothing in the world frame can be compared.
    """
    row = record.source_row
    own = {name: log[name][row] for name in ("w", "q", "v", "v_bat", "f") if name in log}
    if "f" not in log and "a" in log and "q" in log:
        before = np.roll(record.quat, 1, axis=0)
        force_w = log["a"][row] + np.array([0.0, 0.0, gravity])
        own["f"] = Rotation.from_quat(before, scalar_first=True).inv().apply(force_w)
    if "v" not in log and "p" in log:
        own["p"] = log["p"][row]
    return own if "q" in log else {name: own[name] for name in own if name not in ("v", "p")}
