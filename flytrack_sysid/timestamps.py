"""Time stamps as loggers write them, read to one increasing time line.

A stamp is compared with its neighbours on both sides, not only with the one before it. Stamps that
do not fit are left out, and where the stamps jump, a new segment begins. A stream is a series of
rows in the order in which they were written, with the stamps of one clock.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from flytrack_sysid.log import LogError

# Longer steps begin a new segment. 1 s: no window of replay or prediction is longer. 10 steps:
# batteries and other topics at 1 Hz lose single samples without a pause.
MAX_GAP_S, MAX_GAP_STEPS = 1.0, 10.0
# Maximum number of successive stamps that are left out between neighbours that fit each other: a
# tenth of a second at 250 Hz.
MAX_STRAY_ROWS = 25
# Fewer rows between two jumps are strays, not a segment: no estimate can use 10 rows.
MIN_SEGMENT_ROWS = 10
MIN_SEGMENT_FRACTION = 0.5  # of the longest one, for streams that have less than 20 rows
# Rows kept on both sides of strays must be as far apart in time as their number of rows usually
# takes. Otherwise the clock was set back, and the rows are further apart than their stamps. 0.9: a
# clock that is set back by n rows would look like strays only over 10 n rows, which is more than
# MAX_STRAY_ROWS for more than 2 rows.
MIN_SPAN_FRACTION = 0.9
MAX_REORDERED_ROWS = 2  # swapped or repeated rows span less; they move time by at most two steps
ROLL_OVERS_S = (
    2**32 * 1e-6,
    2**32 * 1e-3,
)  # of 32-bit counters of us (71.6 min) and of ms (49.7 days)
MAX_UNSET_STEPS = 3.0  # a longer step after a first stamp of 0 shows that it meant "not set"
# Between a sample and its recording: transport takes ms; clocks that count from other moments
# differ by minutes.
MAX_LATENCY_S = 1.0
# Jumps per row, and in all, of a clock that is read: with more, the rows kept would be arbitrary.
MAX_BREAK_FRACTION, MIN_BREAKS = 0.25, 10
# A pack's voltage changes by less than 0.1 V a cell in a minute at rest.
MAX_BATTERY_DISTANCE_S = 60.0


class Clock(NamedTuple):
    """The valid stamps of a stream.

    Attributes:
        is_used: which rows have a valid stamp, (num_rows,) bool.
        times: of those rows, s, without roll-over, increasing within an epoch.
        epochs: of those rows, int from 0: how often the clock was set back before.
        max_gap_s: longer steps separate segments; infinite for events.
        faults: number of rows or jumps by the kind of fault.
    """

    is_used: np.ndarray
    times: np.ndarray
    epochs: np.ndarray
    max_gap_s: float
    faults: dict[str, int]

    def describe(self, name: str) -> list[str]:
        """Return sentences on what was left out, of how many rows, and on jumps of the clock."""
        sentences = []
        num_rows, num_used = len(self.is_used), len(self.times)
        if num_used < num_rows:
            reasons = [
                f"{self.faults[fault]} {fault}"
                for fault in (NOT_FINITE, NOT_SET, REPEATED, STRAY)
                if self.faults[fault]
            ]
            count = f"{num_rows - num_used} of {num_rows} rows of {name} left out"
            sentences.append(f"{count}: {', '.join(reasons)}")
        if self.faults[ROLL_OVER]:
            sentences.append(
                f"32-bit clock of {name} rolled over {self.faults[ROLL_OVER]} times: unwrapped"
            )
        if self.faults[SET_BACK]:
            count = f"clock of {name} set back {self.faults[SET_BACK]} times"
            sentences.append(f"{count}: a new segment begins at each")
        if self.faults[GAP]:
            count = f"{self.faults[GAP]} gaps above {self.max_gap_s:.3g} s in the time of {name}"
            sentences.append(f"{count}: a new segment begins after each")
        return sentences


NOT_FINITE, NOT_SET = "not finite numbers", "stamped 0 before the clock was set"
REPEATED, STRAY = "with a repeated stamp", "with a stamp far from their neighbours'"
ROLL_OVER, SET_BACK, GAP = "roll-over", "set back", "gap"


def read_clock(source: str, name: str, stamps: np.ndarray, are_events: bool = False) -> Clock:
    """Read the stamps of one stream.

    Args:
        source: the log, for messages.
        name: of the stream, for messages.
        stamps: in the order in which the rows were written, s, (num_rows,).
        are_events: rows are written when something happens, so that any gap is possible.

    Returns:
        The clock, with at least one row. Rows that are repeated or that do not fit their neighbours
        are not used.

    Raises:
        LogError: no stamp is a finite number, or a quarter of them do not fit the one before.
    """
    stamps = np.asarray(stamps, float)
    faults = dict.fromkeys((NOT_FINITE, NOT_SET, REPEATED, STRAY, ROLL_OVER, SET_BACK, GAP), 0)
    rows = np.flatnonzero(np.isfinite(stamps))
    faults[NOT_FINITE] = len(stamps) - len(rows)
    if not len(rows):
        raise LogError(
            f"{source}: time of {name}: found no finite stamp in {len(stamps)} rows, expected some"
        )
    num_unset = _count_unset(stamps[rows])
    faults[NOT_SET], rows = num_unset, rows[num_unset:]
    is_new = np.diff(stamps[rows], prepend=np.nan) != 0.0
    faults[REPEATED], rows = int(np.sum(~is_new)), rows[is_new]
    step_s = _usual_step(stamps[rows])
    max_gap_s = np.inf if are_events else max(MAX_GAP_S, MAX_GAP_STEPS * step_s)
    steps = np.diff(stamps[rows])
    breaks = np.flatnonzero((steps <= 0.0) | (steps > max_gap_s)) + 1
    if len(breaks) > max(MIN_BREAKS, MAX_BREAK_FRACTION * len(rows)):
        problem = (
            f"found {len(breaks)} jumps in {len(rows)} stamps, expected steps of up to "
            f"{max_gap_s:.3g} s"
        )
        raise LogError(f"{source}: time of {name}: {problem}")
    times, is_kept, is_start, faults[ROLL_OVER] = _join_runs(
        stamps[rows], breaks, step_s, max_gap_s
    )
    num_candidates = len(rows)
    rows, times, piece = rows[is_kept], times[is_kept], np.cumsum(is_start[is_kept]) - 1
    counts = np.bincount(piece)
    min_rows = (
        1.0 if are_events else min(float(MIN_SEGMENT_ROWS), MIN_SEGMENT_FRACTION * counts.max())
    )
    is_long = counts[piece] >= min_rows
    rows, times = rows[is_long], times[is_long]
    faults[STRAY] = num_candidates - len(rows)
    steps = np.diff(times)
    faults[SET_BACK], faults[GAP] = int(np.sum(steps <= 0.0)), int(np.sum(steps > max_gap_s))
    is_used = np.zeros(len(stamps), bool)
    is_used[rows] = True
    epochs = np.cumsum(np.diff(times, prepend=-np.inf) <= 0.0)
    return Clock(is_used, times, epochs, max_gap_s, faults)


def _count_unset(stamps: np.ndarray) -> int:
    """Return the number of stamps at the beginning that are 0 because the clock was not set yet."""
    num_zeros = int(np.argmax(stamps != 0.0)) if np.any(stamps != 0.0) else 0
    step_s = _usual_step(stamps[num_zeros:])
    is_far = num_zeros > 0 and step_s > 0.0 and abs(stamps[num_zeros]) > MAX_UNSET_STEPS * step_s
    return num_zeros if is_far else 0


def _usual_step(stamps: np.ndarray) -> float:
    """Return the median step forward, s; 0 if there is none."""
    steps = np.diff(stamps)
    return float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 0.0


def _join_runs(
    stamps: np.ndarray, breaks: np.ndarray, step_s: float, max_gap_s: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Join runs of stamps that fit each other, over strays and roll-overs between them.

    Args:
        stamps: none equal to the one before, s, (num_rows,).
        breaks: rows that do not fit the row before, (num_breaks,).
        step_s: the usual step.
        max_gap_s: the longest step within a segment.

    Returns:
        times: without roll-over, (num_rows,) s.
        is_kept: which rows are kept, (num_rows,) bool.
        is_start: which rows begin a piece, (num_rows,) bool.
        num_rolls: number of roll-overs.
    """
    times, is_kept = stamps.copy(), np.ones(len(stamps), bool)
    is_start = np.zeros(len(stamps), bool)
    is_start[:1] = True
    rolled_s, num_rolls = 0.0, 0
    for start, end in pairwise([*breaks.tolist(), len(stamps)]):
        times[start:end] += rolled_s
        head = np.arange(start, min(end, start + MAX_STRAY_ROWS + 1))
        window = max(0, start - 2 * MAX_STRAY_ROWS)
        tail = (window + np.flatnonzero(is_kept[window:start]))[-MAX_STRAY_ROWS - 1 :]
        joint = _cheapest_joint(times, tail, head, step_s, max_gap_s)
        if joint is None:
            is_start[start] = True
            continue
        last, first, roll_s = joint
        is_kept[last + 1 : first] = False
        if roll_s:
            times[start:end] += roll_s
            rolled_s, num_rolls = rolled_s + roll_s, num_rolls + 1
    return times, is_kept, is_start, num_rolls


def _cheapest_joint(
    times: np.ndarray, tail: np.ndarray, head: np.ndarray, step_s: float, max_gap_s: float
) -> tuple[int, int, float] | None:
    """Return the pair of rows that joins two runs with the fewest rows left out.

    Args:
        times: (num_rows,) s.
        tail: last rows of the run before.
        head: first rows of the run after.
        step_s: the usual step.
        max_gap_s: the longest step within a segment.

    Returns:
        The row of the tail, the row of the head, and the roll-over between them, s; None if no pair
        fits.
    """
    removed = np.arange(len(tail))[::-1, None] + np.arange(len(head))
    rows_apart = head - tail[:, None]
    apart_s = times[head] - times[tail][:, None]
    best, joint = MAX_STRAY_ROWS + 1, None
    for roll_s in (0.0, *ROLL_OVERS_S):
        span_s = apart_s + roll_s
        is_steady = span_s >= MIN_SPAN_FRACTION * step_s * rows_apart
        fits = (
            (span_s > 0.0) & (span_s <= max_gap_s) & (is_steady | (removed <= MAX_REORDERED_ROWS))
        )
        cost = np.where(fits, removed, best)
        row, column = np.unravel_index(np.argmin(cost), cost.shape)
        if cost[row, column] < best:
            best, joint = int(cost[row, column]), (int(tail[row]), int(head[column]), roll_s)
    return joint


def put_on_one_line(source: str, clocks: Mapping[str, Clock], base: str) -> dict[str, np.ndarray]:
    """Put the streams of one log on one increasing time line.

    Where the clock was set back, later times of all streams are moved behind the earlier ones. The
    battery changes so slowly that it may end before the base begins.

    Args:
        source: the log, for messages.
        clocks: of the streams, by name; all count from the same moment.
        base: the stream whose rows become those of the log.

    Returns:
        The times of each stream's used rows, s.

    Raises:
        LogError: two streams have no time in common, or were not set back equally often.
    """
    num_epochs = int(clocks[base].epochs[-1]) + 1
    spacing_s = 2.0 * max(
        clock.max_gap_s for clock in clocks.values() if np.isfinite(clock.max_gap_s)
    )
    for name, clock in clocks.items():
        if int(clock.epochs[-1]) + 1 != num_epochs:
            counts = f"{clock.epochs[-1]} times, that of {base} {num_epochs - 1} times"
            raise LogError(
                f"{source}: clock of {name}: set back {counts}; which rows belong together?"
            )
        distance_s = MAX_BATTERY_DISTANCE_S if name == "v_bat" else 0.0
        if np.isfinite(clock.max_gap_s):  # the last event holds until the next
            _check_common(source, name, clock, base, clocks[base], distance_s)
    shifts_s, end_s = np.zeros(num_epochs), -np.inf
    for epoch in range(num_epochs):
        ranges = [clock.times[clock.epochs == epoch][[0, -1]] for clock in clocks.values()]
        starts, ends = np.transpose(ranges)
        if epoch:
            shifts_s[epoch] = end_s + spacing_s - starts.min()
        end_s = ends.max() + shifts_s[epoch]
    return {name: clock.times + shifts_s[clock.epochs] for name, clock in clocks.items()}


def _check_common(
    source: str, name: str, clock: Clock, base: str, base_clock: Clock, distance_s: float
) -> None:
    """Raise LogError for a stream that is in no epoch within a distance of the base's times."""
    for epoch in range(int(base_clock.epochs[-1]) + 1):
        times = clock.times[clock.epochs == epoch]
        base_times = base_clock.times[base_clock.epochs == epoch]
        if times[0] - base_times[-1] <= distance_s and base_times[0] - times[-1] <= distance_s:
            return
    ranges = [f"{times[0]:.6f} to {times[-1]:.6f} s" for times in (clock.times, base_clock.times)]
    problem = f"found {ranges[0]}, that of {base} {ranges[1]}"
    raise LogError(
        f"{source}: clock of {name}: {problem}; expected times in common, counted from one moment"
    )


def number_segments(times: np.ndarray, max_gap_s: float) -> np.ndarray:
    """Return the segment of each row, (num_rows,) int; a step above ``max_gap_s`` starts one."""
    return np.cumsum(np.diff(times, prepend=times[:1]) > max_gap_s)
