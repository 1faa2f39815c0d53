"""Which rows of a log a fit sees, and which are held out to judge it."""

import numpy as np

from flytrack_sysid.log import FlightLog

HELD_OUT_EVERY = 4
MAX_BLOCK_S = 5.0
MIN_BLOCKS = 8


def blocks_of(log: FlightLog) -> np.ndarray:
    """Return the number of the block that each row belongs to, (num_rows,) int, from 0 on.

    A block is a segment, or a piece of a long one: segments are cut evenly into pieces of at most 5
    s, and of at most an eighth of the log.
    """
    starts = np.flatnonzero(log.is_start())
    durations = log.time[np.append(starts[1:], len(log)) - 1] - log.time[starts]
    longest_s = min(MAX_BLOCK_S, durations.sum() / MIN_BLOCKS)
    return cut_evenly(log.time, log.is_start(), max(longest_s, np.finfo(float).tiny))


def cut_evenly(times: np.ndarray, is_first: np.ndarray, longest_s: float) -> np.ndarray:
    """Return the number of each row's piece, (num_rows,) int.

    Each stretch is cut evenly into pieces of at most ``longest_s``.

    is_first: (num_rows,) bool, where a stretch begins.
    """
    number = np.cumsum(is_first) - 1
    first = np.flatnonzero(is_first)
    duration = times[np.append(first[1:], len(times)) - 1] - times[first]
    # The tiny part keeps rounding from cutting a stretch that just fits.
    pieces = np.maximum(1, np.ceil(duration / longest_s - 1e-6)).astype(int)
    share = (times - times[first][number]) / np.maximum(duration, 1e-9)[number]
    piece = np.minimum((share * pieces[number]).astype(int), pieces[number] - 1)
    return (np.cumsum(pieces) - pieces)[number] + piece


def held_out_rows(log: FlightLog, every: int = HELD_OUT_EVERY) -> np.ndarray:
    """Return held-out rows, (num_rows,) bool: the last of every ``every`` blocks; none if 0.

    Raises ValueError for 1, which leaves nothing, and below 0.
    """
    if every == 1 or every < 0:
        raise ValueError(f"every: found {every}, expected 0, 2, 3, ...")
    if every == 0:
        return np.zeros(len(log), bool)
    return blocks_of(log) % every == every - 1
