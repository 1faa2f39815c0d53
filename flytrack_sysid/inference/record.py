"""A log made ready for replay: on even steps, gaps filled with rows that count for nothing.

Commands drive a replay, so a lost row matters twice: its measurements are missing, and so is its
command. Filled rows get commands interpolated between their neighbours. ``command_doubt`` holds the
standard deviation of the error of these commands, so that rows where it matters can be left out.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.state import ACTION_SIZE
from flytrack_sysid.kinematics import derivative, since_first
from flytrack_sysid.log import GAP_STEPS, FlightLog, time_in_line, usual_step
from flytrack_sysid.log_voltage import assumed_voltage
from flytrack_sysid.resample import interpolate, interpolate_quaternions
from flytrack_sysid.split import block_numbers, cut_evenly

MAX_FILLED_S = 0.1  # after a longer gap a new flight begins
# Without a voltage, thrust has another relative error in each flight, and so the velocity drifts.
WINDOW_WITHOUT_VOLTAGE_S = 1.25
WINDOW_S = 2.5  # over which increments of velocity and attitude are followed
PADDED_TO = 1024  # rows: logs of about the same length share one compiled program
UPRIGHT = (1.0, 0.0, 0.0, 0.0)  # attitude where none was logged
# Rows with a more uncertain applied action count for nothing: half a gyro's noise at full stick.
MAX_DOUBT = 0.005
APPLIED_UNKNOWN = 1.0  # standard deviation of an unknown applied action


class Record(NamedTuple):
    """Rows of a replay, padded; row k + 1 follows row k after ``step_s``.

    Absent channels are 0, the attitude upright, and the voltage ``assumed_voltage``.

    Attributes:
        source_row: the log's row; -1 for filled rows and padding, (num_rows,) int.
        step_s: time to the next row, (num_rows,) s.
        command: (num_rows, 4).
        command_doubt: standard deviation of the command's error, (num_rows, 4).
        begins: a flight starts here, (num_rows,) bool.
        is_applied_known: ``applied`` was measured here, (num_rows,) bool.
        applied: applied action, (num_rows, 4).
        pos_w: (num_rows, 3) m.
        vel_w: (num_rows, 3) m/s.
        quat: (num_rows, 4).
        battery_v: (num_rows,) V.
        piece: number of the stretch of at most 2.5 s, none across blocks, (num_rows,) int.
        time_s: since the log began; of several logs, since each began, (num_rows,) s.
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

    @property
    def median_step_s(self) -> float:
        """Usual time between rows, s."""
        return float(np.median(self.step_s))


def _new_times(
    log: FlightLog, usual_step_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the times of a log with gaps filled.

    Args:
        log: with segments on one time line.
        usual_step_s: of each row's segment, (num_rows,) s.

    Returns:
        times: (num_new_rows,) s.
        rows: the log's row; -1 - row for rows filled after it.
        begins: where a flight begins, (num_new_rows,) bool.
    """
    steps = np.diff(log.time, append=log.time[-1])
    ends = np.append(log.segment[1:] != log.segment[:-1], True)
    is_long = ~ends & (steps > MAX_FILLED_S)
    is_gap = ~ends & ~is_long & (steps > GAP_STEPS * usual_step_s)
    num_parts = np.where(is_gap, np.round(steps / usual_step_s).astype(int), 1)
    num_parts = np.maximum(num_parts, 1)
    row = np.repeat(np.arange(len(log)), num_parts)
    index_in_step = np.arange(len(row)) - np.repeat(np.cumsum(num_parts) - num_parts, num_parts)
    times = log.time[row] + index_in_step * (steps / num_parts)[row]
    begins = (index_in_step == 0) & np.append(True, (ends | is_long)[:-1])[row]
    return times, np.where(index_in_step == 0, row, -1 - row), begins


def _doubts(log: FlightLog, pieces: np.ndarray) -> np.ndarray:
    """Return the standard deviation of commands filled in after each row, (num_rows, 4).

    It is 0 for a command that changes evenly, and half the jump for one that jumps in the gap.
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
    """Return the velocity, measured or differentiated from positions; 0 without either."""
    if "v" in log:
        return log["v"]
    return derivative(log, log["p"]) if "p" in log else np.zeros((len(log), 3))


def _applied(log: FlightLog) -> np.ndarray:
    """Return the applied action, or what stands for it where none is logged, (num_rows, 4).

    That is the command; of motors a craft that does not turn, at their mean.
    """
    if "uprev" in log:
        return log["uprev"]
    if not log.has_motors:
        return log["u"]
    return np.pad(log.throttle[:, None], ((0, 0), (3, 0)))


class Filled(NamedTuple):
    """A log with rows interpolated in its gaps.

    Attributes:
        log: the filled log; segments end where a gap is too long to be filled.
        source_row: the row of the original log; -1 for added rows, (num_rows,) int.
        behind: that row, or the row before the gap, (num_rows,) int.
        command_doubt: standard deviation of the command's error, (num_rows, 4).
    """

    log: FlightLog
    source_row: np.ndarray
    behind: np.ndarray
    command_doubt: np.ndarray


def fill_gaps(log: FlightLog) -> Filled:
    """Return a log without gaps."""
    usual_step_s = usual_step(log)
    in_line = replace(log, time=time_in_line(log, usual_step_s[log.is_start()]))
    times, rows, begins = _new_times(in_line, usual_step_s)
    is_measured = rows >= 0
    behind = np.where(is_measured, rows, -1 - rows)
    pieces = np.bincount(behind, minlength=len(log))
    channels = {}
    for name, values in log.channels.items():
        interpolate_channel = interpolate_quaternions if name == "q" else interpolate
        channels[name], _ = interpolate_channel(in_line.time, values, times)
        channels[name][is_measured] = values[rows[is_measured]]
    filled = replace(
        log,
        time=times - (in_line.time - log.time)[behind],
        channels=channels,
        segment=np.cumsum(begins) - 1,
    )
    doubt = np.where(is_measured[:, None], 0.0, _doubts(log, pieces)[behind])
    return Filled(filled, np.where(is_measured, rows, -1), behind, doubt)


def build_record(filled: Filled) -> Record:
    """Return a log without gaps as a record, without padding and in one piece."""
    log, begins = filled.log, filled.log.is_start()
    zeros = np.zeros((len(log), 3))
    is_first_row = np.append(True, np.diff(log.time) < 0.0)  # of each log, where several are one
    after_gap = np.append(False, filled.source_row[:-1] < 0) & (filled.source_row >= 0)
    return Record(
        source_row=filled.source_row,
        # To the next row of the flight; the usual step at the flight's end.
        step_s=np.where(
            np.append(begins[1:], True), usual_step(log), np.diff(log.time, append=log.time[-1])
        ),
        command=log["u"],
        command_doubt=filled.command_doubt,
        begins=begins,
        is_applied_known=(begins | after_gap) & ("uprev" in log),
        applied=_applied(log),
        pos_w=log.channels.get("p", zeros),
        vel_w=_velocity(log),
        quat=log["q"] if "q" in log else np.tile(UPRIGHT, (len(log), 1)),
        battery_v=log["v_bat"][:, 0] if "v_bat" in log else zeros[:, 0] + assumed_voltage(log),
        piece=np.zeros(len(log), int),
        time_s=since_first(log.time, is_first_row),
    )


def make_record(log: FlightLog) -> Record:
    """Return a log ready for replay."""
    filled = fill_gaps(log)
    record = build_record(filled)
    longest_s = WINDOW_S if "v_bat" in log else WINDOW_WITHOUT_VOLTAGE_S
    is_first = record.begins | np.append(True, np.diff(block_numbers(log)[filled.behind]) != 0)
    return _padded(record._replace(piece=cut_evenly(filled.log.time, is_first, longest_s)))


def _padded(record: Record) -> Record:
    """Return the record with rows appended that are never scored."""
    missing = -len(record.source_row) % PADDED_TO

    def pad(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, np.repeat(values[-1:], missing, axis=0)])

    padded = Record(*(pad(values) for values in record))
    source_row, begins = padded.source_row.copy(), padded.begins.copy()
    if missing:
        source_row[-missing:], begins[-missing:] = -1, True
    return padded._replace(source_row=source_row, begins=begins)


def is_applied_certain(record: Record, tau: np.ndarray) -> np.ndarray:
    """Return where a replay's applied action is certain enough to score errors, (num_rows, 4).

    Uncertainty comes from lost commands and from the applied action at the start of a flight. Both
    decay with the lags.

    Args:
        record: the rows of the replay.
        tau: lags of roll, pitch, yaw and thrust, (4,) s.
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
    """Return a log's measured channels on the record's rows; values in filled rows are arbitrary.

    ``f`` is computed from ``a`` where there is no accelerometer; ``p`` is included only without
    ``v``. Without ``q`` no channel in the world frame is included.
    """
    row = record.source_row
    channels = {name: log[name][row] for name in ("w", "q", "v", "v_bat", "f") if name in log}
    if "f" not in log and "a" in log and "q" in log:
        before = np.roll(record.quat, 1, axis=0)
        force_w = log["a"][row] + np.array([0.0, 0.0, gravity])
        channels["f"] = Rotation.from_quat(before, scalar_first=True).inv().apply(force_w)
    if "v" not in log and "p" in log:
        channels["p"] = log["p"][row]
    return (
        channels
        if "q" in log
        else {name: channels[name] for name in channels if name not in ("v", "p")}
    )
