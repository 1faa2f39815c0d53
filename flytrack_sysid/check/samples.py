"""Samples that are no measurements: held, repeated, or interpolated where that is wrong."""

import numpy as np

from flytrack_sysid.check.explain import Change
from flytrack_sysid.kinematics import attitude_of, summed_turns
from flytrack_sysid.log import CHANNELS, FlightLog, usual_step

SENSORS = ("w", "f", "q", "v", "p")
MIN_HELD = 3  # rows: sensors at half the log's rate are common
MIN_REGULAR = 0.9  # share of the runs of equal values that are as long; slow motion has any length
MIN_REPEATED = 0.02  # share of rows that repeat all sensors between rows in which all move
PERIODS, MAX_PERIODIC = (2, 3, 4), 0.8  # rows; share of such rows at a multiple from the one before
MIN_JUMP = 0.2  # rad of a row more than the gyroscope turned by
MIN_TURN, MIN_JUMPS = 2.0, 2  # rad in such rows together: almost a full turn; number of turns
MAX_JUMPING = 0.1  # share of such rows: more are noise
NEAR_WRAP = np.deg2rad(120.0)  # a heading that is interpolated across the wrap jumps from there


def _repeats(log: FlightLog, channel: str) -> np.ndarray:
    """Return which rows equal the one before, (num_rows,) bool."""
    values = log[channel]
    same = np.all(values[1:] == values[:-1], axis=1) & ~log.is_start()[1:]
    return np.append(False, same)


def _held_rows(repeats: np.ndarray) -> int:
    """Return for how many rows each sample is held; 1 if that varies."""
    runs = np.diff(np.flatnonzero(~repeats))
    if len(runs) == 0:
        return 1
    usual = int(np.median(runs))
    return usual if np.mean(runs == usual) >= MIN_REGULAR else 1


def _repeated_share(repeats: list[np.ndarray]) -> float:
    """Return the share of rows that repeat all sensors, where all move before and after.

    It is 0 if they come periodically: then the log is faster than the sensors.
    """
    same, moving = np.all(repeats, axis=0)[1:-1], ~np.any(repeats, axis=0)
    is_between = moving[:-2] & moving[2:]
    distances = np.diff(np.flatnonzero(same & is_between))
    if any(np.mean(distances % period == 0) > MAX_PERIODIC for period in PERIODS if len(distances)):
        return 0.0
    return float(np.mean(same[is_between]))


def sample_changes(log: FlightLog) -> list[Change]:
    """Return what was done to the samples of a log."""
    sensors = [name for name in SENSORS if name in log and np.ptp(log[name], axis=0).any()]
    repeats = {name: _repeats(log, name) for name in sensors}
    held = {name: _held_rows(same) for name, same in repeats.items()}
    found = [Change(name, "held", rows) for name, rows in held.items() if rows >= MIN_HELD]
    others = [same for name, same in repeats.items() if held[name] < MIN_HELD]
    share = _repeated_share(others) if others else 0.0
    found += [Change("rows", "repeated", share)] * (share > MIN_REPEATED)
    return found + [Change("q", "wrapped", True)] * is_wrapped(log)


def describe_stuck(log: FlightLog) -> tuple[str, ...]:
    """Return a sentence on each column of a sensor that never changes: it cannot be compared."""
    columns = [
        column
        for channel in SENSORS
        if channel in log
        for column, spread in zip(CHANNELS[channel], np.ptp(log[channel], axis=0), strict=True)
        if spread == 0.0
    ]
    return tuple(f"{column}: the same in every row, so not compared: stuck?" for column in columns)


def is_wrapped(log: FlightLog) -> bool:
    """Return whether the heading of the attitude was interpolated across +-180 degrees.

    There it turns by almost a full turn within some rows, and the gyroscope does not.
    """
    if "q" not in log or "w" not in log:
        return False
    turns = np.diff(summed_turns(attitude_of(log)), axis=0)
    measured = log["w"][1:] * usual_step(log)[1:, None]
    excess = np.linalg.norm(turns, axis=1) - np.linalg.norm(measured, axis=1)
    is_jump = (excess > MIN_JUMP) & ~log.is_start()[1:]
    edges = np.diff(is_jump.astype(int), prepend=0, append=0)
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    summed = np.concatenate([[0.0], np.cumsum(excess)])
    starts = starts[summed[ends] - summed[starts] > MIN_TURN]
    if len(starts) < MIN_JUMPS or is_jump.mean() > MAX_JUMPING:
        return False
    w, x, y, z = log["q"][starts].T  # the row before each jump
    heading = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return bool(np.mean(np.abs(heading) > NEAR_WRAP) > 0.8)
