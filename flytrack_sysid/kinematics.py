"""What connects the channels of one motion: gravity, turns, and windows to compare them over."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import nominal_parameters
from flytrack_sysid.log import FlightLog

GRAVITY = float(nominal_parameters().g)  # m/s^2
WEIGHT_W = np.array([0.0, 0.0, GRAVITY])  # specific force at rest, world frame
WINDOWS_S = (0.1, 0.3, 1.0)  # long against the noise of a sample; short ones for fast manoeuvres


class Windows(NamedTuple):
    """Windows of about the same length, none across segments or long gaps.

    Attributes:
        starts: first row, (num_windows,).
        ends: row after the last step, (num_windows,).
        durations: (num_windows,) s.
    """

    starts: np.ndarray
    ends: np.ndarray
    durations: np.ndarray

    def mean_rate(self, values: np.ndarray) -> np.ndarray:
        """Return the change of values, (num_rows, n), over each window, a second."""
        return (values[self.ends] - values[self.starts]) / self.durations[:, None]

    def mean_of(self, log: FlightLog, values: np.ndarray) -> np.ndarray:
        """Return the mean of values, (num_rows, n), over each window; linear between rows."""
        steps = np.diff(log.time)[:, None] * 0.5 * (values[1:] + values[:-1])
        integral = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])
        return self.mean_rate(integral)


def cut_windows(log: FlightLog, length_s: float) -> Windows:
    """Return the windows of a log, without those that a gap makes more than twice as long."""
    is_start = log.is_start()
    flight = np.cumsum(is_start) - 1
    window = np.floor(since_first(log.time, is_start) / length_s)
    edges = np.flatnonzero(is_start | np.append(True, np.diff(window) > 0))
    starts, ends = edges[:-1], edges[1:]
    durations = log.time[ends] - log.time[starts]
    steps = np.diff(log.time)[~is_start[1:]]
    max_duration = 2.0 * max(length_s, np.median(steps)) if len(steps) else 0.0
    keep = (flight[starts] == flight[ends]) & (durations <= max_duration)
    return Windows(starts[keep], ends[keep], durations[keep])


def since_first(values: np.ndarray, is_first: np.ndarray) -> np.ndarray:
    """Return values, (num_rows, ...), less those of the last row before or at each that is first.

    Args:
        values: (num_rows, ...).
        is_first: rows at which counting starts anew, the first row among them, (num_rows,) bool.
    """
    return values - values[is_first][np.cumsum(is_first) - 1]


def attitude_of(log: FlightLog) -> Rotation:
    """Return the attitude of a log's rows."""
    return Rotation.from_quat(log["q"], scalar_first=True)


def acceleration_of(log: FlightLog) -> np.ndarray:
    """Return the acceleration by accelerometer and attitude, world frame, (num_rows, 3) m/s^2."""
    return attitude_of(log).apply(log["f"]) - WEIGHT_W


def summed_turns(attitude: Rotation) -> np.ndarray:
    """Return the sum of the rotations between rows about the body's axes, (num_rows, 3) rad."""
    turns_b = (attitude[:-1].inv() * attitude[1:]).as_rotvec()
    return np.concatenate([np.zeros((1, 3)), np.cumsum(turns_b, axis=0)])


def continuous(quat: np.ndarray) -> np.ndarray:
    """Return quaternions, (num_rows, 4), with signs such that neighbours are close.

    The first has w >= 0.
    """
    flips = np.sum(quat[1:] * quat[:-1], axis=1) < 0.0
    first = quat[:1, 0] < 0.0
    signs = np.where(np.cumsum(np.concatenate([first, flips])) % 2 == 1, -1.0, 1.0)
    return quat * signs[:, None]


def segments_of(log: FlightLog) -> list[slice]:
    """Return the rows of each segment of a log."""
    edges = [*np.flatnonzero(log.is_start()), len(log)]
    return [slice(start, end) for start, end in pairwise(edges)]


def runs_of(is_in: np.ndarray, is_start: np.ndarray) -> list[tuple[int, int]]:
    """Return start and end of each run of True, none across the start of a segment.

    Args:
        is_in: (num_rows,) bool.
        is_start: rows at which a segment starts, (num_rows,) bool.
    """
    starts = np.flatnonzero(is_in & (~np.append(False, is_in[:-1]) | is_start))
    ends = np.flatnonzero(is_in & ~np.append(is_in[1:] & ~is_start[1:], False)) + 1
    return list(zip(starts.tolist(), ends.tolist(), strict=True))


def low_pass(values: np.ndarray, step_s: float, lag_s: float) -> np.ndarray:
    """Return values, (num_rows, ...), as a first-order lag follows them from 0."""
    decay = np.exp(-step_s / lag_s) if lag_s else 0.0
    return lfilter([1.0 - decay], [1.0, -decay], values, axis=0)


def derivative(log: FlightLog, values: np.ndarray) -> np.ndarray:
    """Return the derivative of values, (num_rows, n), by time; 0 in segments of one row."""
    slopes = np.zeros_like(values)
    for rows in segments_of(log):
        if rows.stop - rows.start > 1:
            slopes[rows] = np.gradient(values[rows], log.time[rows], axis=0)
    return slopes


def read_at(log: FlightLog, values: np.ndarray, later_s: float) -> np.ndarray:
    """Return values, (num_rows, n), read some seconds later within each segment; ends are held."""
    result = np.empty_like(values)
    for rows in segments_of(log):
        time = log.time[rows]
        for column in range(values.shape[1]):
            result[rows, column] = np.interp(time + later_s, time, values[rows, column])
    return result


def jackknife_error(estimates: np.ndarray) -> float:
    """Return the standard error of an estimate, by estimates without one block each."""
    count = len(estimates)
    return float(np.sqrt((count - 1) / count * np.sum((estimates - estimates.mean()) ** 2)))
