"""Rows on the ground: the legs carry the craft, and a fit would take its weight for thrust.

On the ground a craft keeps still and its accelerometer shows 1 g, as in a calm hover, but its
thrust command is far below what holds it in the air. That thrust is estimated from the logs
themselves. Without an accelerometer, velocity or position tell that it does not move. In a steady
descent on drag an accelerometer shows 1 g at little thrust, too; there the craft has fallen before,
which the accelerometer shows as well.

A craft that is carried by hand, or hangs on a tether, turns as a flying one does: its rows are not
found.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_sysid.log import FlightLog
from flytrack_sysid.plausibility import GRAVITY, MIN_ROWS, MIN_S, summed_turns

# Blocks of rows: an idle propeller turns tens of times in one, a drone in flight does not keep
# still for one.
BLOCK_S = 0.25
# At rest, over a block. Real logs at rest (Betaflight, Crazyflie; propellers off or idle) show
# rates of at most 0.016 rad/s and a specific force within 3 % of 1 g that varies by 0.045 g.
MAX_RATE = 0.1  # rad/s, mean and standard deviation: bias of a gyroscope, and vibration
MAX_FORCE_ERROR = 0.1  # g, of the mean: scale error of an accelerometer
MAX_FORCE_STD = 0.1  # g: vibration
MAX_REST_SPEED = 0.3  # m/s, where there is no accelerometer: drift of an estimator
MAX_DRIFT_SPEED = 1.0  # m/s, where there is one: a velocity from satellites wanders while it stands
LEVEL_FORCE_ERROR = 0.2  # g: what moves with less thrusts about its weight
# Of the thrust command that hovers: below LOW, a craft at rest stands; next to such rows, up to
# SPOOLING, it still does. Thrust grows about with the square of a command, so that LOW carries a
# quarter of the weight.
LOW, SPOOLING = 0.5, 0.8
# of the commands at rest: a craft that rests at a command hovers at no less
STANDING_QUANTILE = 0.95
MIN_REST_S = 1.0  # without thrust, drag of 1 g +- 10 % lasts for 0.2 s, except in a steady descent
MIN_HOVER = 0.01  # of the command's range: below it, the commands tell nothing
# A descent on drag: m/s of fall gained at low thrust before; drones descend at 8 m/s (ducted
# whoops) or more.
MIN_FALL_SPEED = 4.0
MAX_FALL_S, FALL_STEP_S = 10.0, 0.01  # s: how far back a fall is integrated, in which steps
MAX_FALL_FORCE = 2.0  # g: a descent builds up smoothly, what hits the ground shows more


class _Blocks(NamedTuple):
    """Means over blocks of about ``BLOCK_S``, (num_blocks,); ``of_row`` is (num_rows,) int.

    throttle: thrust command as a fraction of its range. is_at_rest: still at 1 g. is_level: moving
    at about 1 g. is_start: the first of a segment.
    """

    of_row: np.ndarray
    throttle: np.ndarray
    is_at_rest: np.ndarray
    is_level: np.ndarray
    is_start: np.ndarray


def find_ground(logs: Sequence[FlightLog]) -> list[np.ndarray]:
    """Return which rows of each log are on the ground, (num_rows,) bool.

    A log that never leaves the ground is on it in all rows. Logs without rates or attitude, or
    without accelerometer, velocity and position, show nothing.

    Args:
        logs: logs of one craft, which together tell the thrust command that hovers.
    """
    blocks = [_blocks_of(log) for log in logs]
    hover = _hover_throttle([known for known in blocks if known is not None])
    return [
        np.zeros(len(log), bool)
        if known is None or hover < MIN_HOVER
        else _ground_rows(log, known, hover)
        for log, known in zip(logs, blocks, strict=True)
    ]


def _blocks_of(log: FlightLog) -> _Blocks | None:
    """Return the blocks of a log; None where it cannot show rest."""
    if not ("w" in log or "q" in log) or not any(name in log for name in "fvp") or len(log) < 2:
        return None
    is_start = log.is_start()
    run = np.cumsum(is_start) - 1
    number = np.floor((log.time - log.time[is_start][run]) / BLOCK_S)
    is_edge = is_start | np.append(True, np.diff(number) > 0)
    of_row = np.cumsum(is_edge) - 1
    counts = np.bincount(of_row)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(of_row, column) / counts for column in values.T], axis=1)

    def deviation(values: np.ndarray) -> np.ndarray:
        return np.sqrt(mean((values - mean(values)[of_row]) ** 2)).max(axis=1)

    starts = np.flatnonzero(is_edge)
    rates = log["w"] if "w" in log else _rates_of_attitude(log)
    is_still = (np.linalg.norm(mean(rates), axis=1) <= MAX_RATE) & (deviation(rates) <= MAX_RATE)
    velocity = _velocity(log)
    max_speed = MAX_DRIFT_SPEED if "f" in log else MAX_REST_SPEED
    if velocity is not None:
        is_still &= np.linalg.norm(mean(velocity), axis=1) <= max_speed
    if "f" in log:
        force = log["f"] / GRAVITY
        size = np.linalg.norm(mean(force), axis=1)
        is_still &= deviation(force) <= MAX_FORCE_STD
    else:
        assert velocity is not None  # some of f, v, p is there
        acc_w = np.zeros((1, 3))
        if len(counts) > 1:
            acc_w = np.gradient(mean(velocity), mean(log.time[:, None])[:, 0], axis=0)
        size = np.linalg.norm(acc_w / GRAVITY + np.array([0.0, 0.0, 1.0]), axis=1)
    is_at_rest = is_still & (np.abs(size - 1.0) <= MAX_FORCE_ERROR)
    throttle = 0.5 * (mean(log["u"][:, 3:])[:, 0] + 1.0)
    is_level = ~is_at_rest & (np.abs(size - 1.0) <= LEVEL_FORCE_ERROR)
    return _Blocks(of_row, throttle, is_at_rest, is_level, is_start[starts])


def _rates_of_attitude(log: FlightLog) -> np.ndarray:
    return _derivative(log, summed_turns(Rotation.from_quat(log["q"], scalar_first=True)))


def _velocity(log: FlightLog) -> np.ndarray | None:
    if "v" in log:
        return log["v"]
    return _derivative(log, log["p"]) if "p" in log else None


def _derivative(log: FlightLog, values: np.ndarray) -> np.ndarray:
    """Return the derivative of values (num_rows, n) by time, within segments."""
    slopes = np.zeros_like(values)
    for start, end in pairwise(np.append(np.flatnonzero(log.is_start()), len(log))):
        if end - start > 1:
            slopes[start:end] = np.gradient(values[start:end], log.time[start:end], axis=0)
    return slopes


def _hover_throttle(blocks: Sequence[_Blocks]) -> float:
    """Return the throttle that hovers, as a fraction of its range, nan if nothing shows it."""
    level = np.concatenate([[], *(known.throttle[known.is_level] for known in blocks)])
    at_rest = np.concatenate([[], *(known.throttle[known.is_at_rest] for known in blocks)])
    bounds = [float(np.median(level))] if len(level) else []
    bounds += [float(np.quantile(at_rest, STANDING_QUANTILE))] if len(at_rest) else []
    return max(bounds, default=0.0)


def _ground_rows(log: FlightLog, blocks: _Blocks, hover: float) -> np.ndarray:
    """Return which rows of a log are on the ground, (num_rows,) bool."""
    is_low = blocks.throttle < LOW * hover
    is_ground = np.zeros(len(is_low), bool)
    is_candidate = blocks.is_at_rest & (blocks.throttle < SPOOLING * hover)
    for start, end in _runs(is_candidate, blocks.is_start):
        low = _runs(is_low[start:end], blocks.is_start[start:end])
        longest = max((stop - begin for begin, stop in low), default=0)
        if longest * BLOCK_S >= MIN_REST_S and not _is_descent(log, blocks, is_low, start, end):
            is_ground[start:end] = True
    if not is_ground.any():
        return is_ground[blocks.of_row]
    # The blocks next to it have some of the take-off or landing, where legs carry a part.
    is_next = np.zeros_like(is_ground)
    is_next[1:] |= is_ground[:-1] & ~blocks.is_start[1:]
    is_next[:-1] |= is_ground[1:] & ~blocks.is_start[1:]
    is_ground |= is_next
    rows = is_ground[blocks.of_row]
    steps = np.diff(log.time, append=log.time[-1])
    flown_s = steps[~rows & (steps > 0.0) & (steps < BLOCK_S)].sum()
    never_moves = blocks.is_at_rest[~is_ground].all()
    is_too_short = flown_s < MIN_S or np.sum(~rows) < MIN_ROWS
    return np.ones(len(rows), bool) if never_moves or is_too_short else rows


def _runs(is_in: np.ndarray, is_start: np.ndarray) -> list[tuple[int, int]]:
    """Return start and end of each run of True, none across the start of a segment."""
    before = np.append(False, is_in[:-1])
    starts = np.flatnonzero(is_in & (~before | is_start))
    after = np.append(is_in[1:] & ~is_start[1:], False)
    return list(zip(starts, np.flatnonzero(is_in & ~after) + 1, strict=True))


def _is_descent(log: FlightLog, blocks: _Blocks, is_low: np.ndarray, start: int, end: int) -> bool:
    """Return whether the craft gained downward speed, without a hit, before its rest at 1 g.

    is_low: blocks at low thrust, (num_blocks,) bool; the fall is within the run of them that leads
    to rest. start, end: the blocks at rest.
    """
    if "f" not in log or "w" not in log:
        return False  # the velocity told already
    first = start
    while first > 0 and is_low[first - 1] and not blocks.is_start[first]:
        first -= 1
    if first > 0 and not blocks.is_start[first]:
        first -= 1  # thrust may end within this block
    row, last, stop = np.searchsorted(blocks.of_row, [first, start, end])
    row += np.searchsorted(log.time[row:last], log.time[last] - MAX_FALL_S)
    if (
        last - row < 2
        or np.linalg.norm(log["f"][row:last], axis=1).max() > MAX_FALL_FORCE * GRAVITY
    ):
        return False
    at_rest = log["f"][last:stop].mean(axis=0)
    up = at_rest / np.linalg.norm(at_rest)
    time = log.time[row : last + 1]
    stride = max(1, int(FALL_STEP_S * (last - row) / (time[-1] - time[0])))
    index = np.append(np.arange(0, last - row, stride), last - row)
    steps = np.diff(time[index])
    turns = Rotation.from_rotvec(log["w"][row + index[:-1]] * steps[:, None])
    # Backwards from the rest, in whose frame "up" is known.
    turn_to_rest, gained = Rotation.identity(), 0.0
    for k in range(len(steps) - 1, -1, -1):
        turn_to_rest = turns[k] * turn_to_rest
        force = turn_to_rest.inv().apply(log["f"][row + index[k]])
        gained += steps[k] * (force @ up - GRAVITY)
    return bool(gained < -MIN_FALL_SPEED)
