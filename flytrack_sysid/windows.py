"""Windows of a log over which noise averages out, and the slope between two quantities over them."""

from typing import NamedTuple

import numpy as np

from flytrack_sysid.log import FlightLog

WINDOWS_S = (0.1, 0.3, 1.0)  # long against the noise of a sample; short ones for fast manoeuvres
FEWEST_WINDOWS = 10
LEAST_CORRELATION = 0.9  # with less in common, the slope may be that of noise
STILL = 1e-6  # in any unit: what changes by less does not change


class Windows(NamedTuple):
    """Pieces of a log of about one length, none across segments or long gaps; (num_windows,) each.

    starts, ends: first row, and the row after the last step. durations: s.
    """

    starts: np.ndarray
    ends: np.ndarray
    durations: np.ndarray

    def change_of(self, values: np.ndarray) -> np.ndarray:
        """Return by how much (num_rows, ...) values grow over each window."""
        return values[self.ends] - values[self.starts]

    def mean_of(self, log: FlightLog, values: np.ndarray) -> np.ndarray:
        """Return the mean over each window of values (num_rows, n), which change linearly in between."""
        steps = np.diff(log.time)[:, None] * 0.5 * (values[1:] + values[:-1])
        integral = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])
        return self.change_of(integral) / self.durations[:, None]


def windows_of(log: FlightLog, length_s: float) -> Windows:
    """Return the windows of a log; those that a gap makes twice as long are left out."""
    is_start = log.is_start()
    flight = np.cumsum(is_start) - 1
    since_start = log.time - log.time[is_start][flight]
    number = np.floor(since_start / length_s)
    edges = np.flatnonzero(is_start | np.append(True, np.diff(number) > 0))
    starts, ends = edges[:-1], edges[1:]
    durations = log.time[ends] - log.time[starts]
    steps = np.diff(log.time)[~is_start[1:]]
    longest = 2.0 * max(length_s, np.median(steps)) if len(steps) else 0.0
    keep = (flight[starts] == flight[ends]) & (durations <= longest)
    return Windows(starts[keep], ends[keep], durations[keep])


def slope_of(log: FlightLog, change: np.ndarray, rate: np.ndarray) -> float:
    """Return the factor from the change of one quantity to the integral of its rate, nan if none is clear.

    change, rate: (num_rows, 3). The ratio of their sizes over windows of that length at which they move
    most alike: noise in either biases it little where they are highly correlated.
    """
    best, slope = LEAST_CORRELATION, np.nan
    for length_s in WINDOWS_S:
        windows = windows_of(log, length_s)
        if len(windows.starts) < FEWEST_WINDOWS:
            continue
        grown = windows.change_of(change) / windows.durations[:, None]
        summed = windows.mean_of(log, rate)
        size_grown, size_summed = np.linalg.norm(grown), np.linalg.norm(summed)
        if min(size_grown, size_summed) < STILL:
            continue
        correlation = np.sum(grown * summed) / (size_grown * size_summed)
        if correlation >= best:
            best, slope = correlation, float(size_summed / size_grown)
    return slope
