"""Which rows of a log a fit sees, and which are held out to judge it."""

import numpy as np

from flytrack_sysid.log import FlightLog

HELD_OUT_EVERY = 4
LONGEST_BLOCK_S = 5.0
FEWEST_BLOCKS = 8


def blocks_of(log: FlightLog) -> np.ndarray:
    """Return the number of the block that each row belongs to, (num_rows,) int, from 0 on.

    A block is a segment, or a piece of a long one: segments are cut evenly into pieces of at most 5 s, and
    of at most an eighth of the log.
    """
    starts = np.flatnonzero(log.is_start())
    ends = np.append(starts[1:], len(log))
    durations = log.time[ends - 1] - log.time[starts]
    longest = min(LONGEST_BLOCK_S, durations.sum() / FEWEST_BLOCKS)
    block, count = np.zeros(len(log), int), 0
    for start, end, duration in zip(starts, ends, durations, strict=True):
        # The tiny part keeps rounding from cutting a segment that just fits.
        pieces = max(1, int(np.ceil(duration / longest - 1e-6))) if duration > 0 else 1
        share = (log.time[start:end] - log.time[start]) / max(duration, 1e-9)
        block[start:end] = count + np.minimum((share * pieces).astype(int), pieces - 1)
        count += pieces
    return block


def held_out_rows(log: FlightLog, every: int = HELD_OUT_EVERY) -> np.ndarray:
    """Return which rows are held out, (num_rows,) bool: the last of every ``every`` blocks; none if 0.

    Raises ValueError for 1, which leaves nothing, and below 0.
    """
    if every == 1 or every < 0:
        raise ValueError(f"every: found {every}, expected 0, 2, 3, ...")
    if every == 0:
        return np.zeros(len(log), bool)
    return blocks_of(log) % every == every - 1
