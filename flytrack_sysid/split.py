"""Split of a log's rows into those to fit and those held out for validation."""

import numpy as np

from flytrack_sysid.log import FlightLog

HELD_OUT_EVERY = 4
MAX_BLOCK_S = 5.0
MIN_BLOCKS = 8


def block_numbers(log: FlightLog) -> np.ndarray:
    """Return the number of each row's block, (num_rows,) int from 0.

    A block is a segment, or a piece of a long one. Segments are cut evenly into pieces of at most 5
    s, and of at most an eighth of the log.
    """
    starts = np.flatnonzero(log.is_start())
    durations = log.time[np.append(starts[1:], len(log)) - 1] - log.time[starts]
    longest_s = min(MAX_BLOCK_S, durations.sum() / MIN_BLOCKS)
    return cut_evenly(log.time, log.is_start(), max(longest_s, np.finfo(float).tiny))


def cut_evenly(times: np.ndarray, is_first: np.ndarray, longest_s: float) -> np.ndarray:
    """Return the number of each row's piece, (num_rows,) int.

    Each stretch is cut evenly into pieces of at most ``longest_s``.

    Args:
        times: (num_rows,) s.
        is_first: where a stretch begins, (num_rows,) bool.
        longest_s: maximum length of a piece.
    """
    stretch = np.cumsum(is_first) - 1
    first_rows = np.flatnonzero(is_first)
    duration = times[np.append(first_rows[1:], len(times)) - 1] - times[first_rows]
    # The small subtrahend keeps rounding from cutting a stretch that just fits.
    num_pieces = np.maximum(1, np.ceil(duration / longest_s - 1e-6)).astype(int)
    fraction = (times - times[first_rows][stretch]) / np.maximum(duration, 1e-9)[stretch]
    piece = np.minimum((fraction * num_pieces[stretch]).astype(int), num_pieces[stretch] - 1)
    return (np.cumsum(num_pieces) - num_pieces)[stretch] + piece


def held_out_rows(log: FlightLog, every: int = HELD_OUT_EVERY) -> np.ndarray:
    """Return the held-out rows, (num_rows,) bool: the last of every ``every`` blocks; none if 0.

    Raises:
        ValueError: ``every`` is 1, which would leave nothing to fit, or below 0.
    """
    if every == 1 or every < 0:
        raise ValueError(f"every: found {every}, expected 0, 2, 3, ...")
    if every == 0:
        return np.zeros(len(log), bool)
    return block_numbers(log) % every == every - 1
