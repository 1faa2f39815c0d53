"""Rows on the ground: there the legs carry the craft, and a fit would mistake weight for thrust.

On the ground a craft does not move and its accelerometer shows 1 g, as in a calm hover, but its
thrust command is far below that of hover. The thrust command of hover is estimated from the logs
themselves. Without an accelerometer, velocity or position show that the craft does not move. In a
steady descent on drag, an accelerometer shows 1 g at low thrust, too; but the craft has fallen
before, which the accelerometer also shows.

A craft that is carried by hand, or hangs on a tether, turns like a flying one, so its rows are not
found.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_sysid.kinematics import (
    GRAVITY,
    attitude_of,
    derivative,
    runs_of,
    since_first,
    summed_turns,
)
from flytrack_sysid.log import FlightLog
from flytrack_sysid.plausibility import MIN_ROWS, MIN_S

# Length of a block of rows: an idle propeller turns tens of times in it, and a drone in flight does
# not stay motionless for it.
BLOCK_S = 0.25
# Limits of a block at rest. Real logs at rest (Betaflight, Crazyflie; propellers off or idle) show
# rates of at most 0.016 rad/s and a specific force within 3 % of 1 g that varies by 0.045 g.
MAX_RATE = 0.1  # rad/s, mean and standard deviation: bias of a gyroscope, and vibration
MAX_FORCE_ERROR = 0.1  # g, of the mean: scale error of an accelerometer
MAX_FORCE_STD = 0.1  # g: vibration
MAX_REST_SPEED = 0.3  # m/s, where there is no accelerometer: drift of an estimator
MAX_DRIFT_SPEED = 1.0  # m/s, where there is one: a satellite velocity drifts while the craft stands
LEVEL_FORCE_ERROR = 0.2  # g: a moving craft with a smaller error has a thrust of about its weight
# Fractions of the thrust command of hover. Below LOW, a craft at rest is on the ground; next to
# such rows, it is on the ground up to SPOOLING. Thrust grows about with the square of the command,
# so LOW carries a quarter of the weight.
LOW, SPOOLING = 0.5, 0.8
# Of the commands at rest: the command of hover is not below one at which the craft rests.
STANDING_QUANTILE = 0.95
MIN_REST_S = 1.0  # without thrust, drag of 1 g +- 10 % lasts for 0.2 s, except in a steady descent
MIN_HOVER = 0.01  # of the command's range: below, the commands show nothing
# Of a descent on drag: m/s of downward speed gained at low thrust before it; drones descend at 8
# m/s (ducted whoops) or more.
MIN_FALL_SPEED = 4.0
MAX_FALL_S, FALL_STEP_S = 10.0, 0.01  # s: duration and step of the integration of a fall
MAX_FALL_FORCE = 2.0  # g: a descent builds up smoothly; an impact on the ground shows more


class _Blocks(NamedTuple):
    """Means over blocks of about ``BLOCK_S``.

    Attributes:
        of_row: block of each row, (num_rows,) int.
        throttle: thrust command as a fraction of its range, (num_blocks,).
        is_at_rest: motionless at 1 g, (num_blocks,) bool.
        is_level: moving at about 1 g, (num_blocks,) bool.
        is_start: the first of a segment, (num_blocks,) bool.
    """

    of_row: np.ndarray
    throttle: np.ndarray
    is_at_rest: np.ndarray
    is_level: np.ndarray
    is_start: np.ndarray


def find_ground(logs: Sequence[FlightLog]) -> list[np.ndarray]:
    """Return which rows of each log are on the ground, (num_rows,) bool.

    A log that never leaves the ground is on it in all rows. In logs without rates and attitude, or
    without accelerometer, velocity and position, no row is found.

    Args:
        logs: logs of one craft, which together determine the thrust command of hover.
    """
    blocks_by_log = [_blocks_of(log) for log in logs]
    hover = _hover_throttle([log_blocks for log_blocks in blocks_by_log if log_blocks is not None])
    return [
        np.zeros(len(log), bool)
        if log_blocks is None or hover < MIN_HOVER
        else _ground_rows(log, log_blocks, hover)
        for log, log_blocks in zip(logs, blocks_by_log, strict=True)
    ]


def _blocks_of(log: FlightLog) -> _Blocks | None:
    """Return the blocks of a log; None if its channels cannot show rest."""
    if not ("w" in log or "q" in log) or not any(name in log for name in "fvp") or len(log) < 2:
        return None
    is_start = log.is_start()
    block_in_segment = np.floor(since_first(log.time, is_start) / BLOCK_S)
    is_edge = is_start | np.append(True, np.diff(block_in_segment) > 0)
    of_row = np.cumsum(is_edge) - 1
    counts = np.bincount(of_row)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(of_row, column) / counts for column in values.T], axis=1)

    def deviation(values: np.ndarray) -> np.ndarray:
        return np.sqrt(mean((values - mean(values)[of_row]) ** 2)).max(axis=1)

    starts = np.flatnonzero(is_edge)
    rates = log["w"] if "w" in log else derivative(log, summed_turns(attitude_of(log)))
    is_motionless = (np.linalg.norm(mean(rates), axis=1) <= MAX_RATE) & (
        deviation(rates) <= MAX_RATE
    )
    velocity = _velocity(log)
    max_speed = MAX_DRIFT_SPEED if "f" in log else MAX_REST_SPEED
    if velocity is not None:
        is_motionless &= np.linalg.norm(mean(velocity), axis=1) <= max_speed
    if "f" in log:
        force = log["f"] / GRAVITY
        size = np.linalg.norm(mean(force), axis=1)
        is_motionless &= deviation(force) <= MAX_FORCE_STD
    else:
        assert velocity is not None  # the log has f, v or p
        acc_w = np.zeros((1, 3))
        if len(counts) > 1:
            acc_w = np.gradient(mean(velocity), mean(log.time[:, None])[:, 0], axis=0)
        size = np.linalg.norm(acc_w / GRAVITY + np.array([0.0, 0.0, 1.0]), axis=1)
    is_at_rest = is_motionless & (np.abs(size - 1.0) <= MAX_FORCE_ERROR)
    throttle = 0.5 * (mean(log.throttle[:, None])[:, 0] + 1.0)
    is_level = ~is_at_rest & (np.abs(size - 1.0) <= LEVEL_FORCE_ERROR)
    return _Blocks(of_row, throttle, is_at_rest, is_level, is_start[starts])


def _velocity(log: FlightLog) -> np.ndarray | None:
    if "v" in log:
        return log["v"]
    return derivative(log, log["p"]) if "p" in log else None


def _hover_throttle(blocks: Sequence[_Blocks]) -> float:
    """Return the throttle of hover as a fraction of its range; 0 if no block shows it."""
    level = np.concatenate(
        [[], *(log_blocks.throttle[log_blocks.is_level] for log_blocks in blocks)]
    )
    at_rest = np.concatenate(
        [[], *(log_blocks.throttle[log_blocks.is_at_rest] for log_blocks in blocks)]
    )
    bounds = [float(np.median(level))] if len(level) else []
    bounds += [float(np.quantile(at_rest, STANDING_QUANTILE))] if len(at_rest) else []
    return max(bounds, default=0.0)


def _ground_rows(log: FlightLog, blocks: _Blocks, hover: float) -> np.ndarray:
    """Return which rows of a log are on the ground, (num_rows,) bool."""
    is_low = blocks.throttle < LOW * hover
    is_ground = np.zeros(len(is_low), bool)
    is_candidate = blocks.is_at_rest & (blocks.throttle < SPOOLING * hover)
    for start, end in runs_of(is_candidate, blocks.is_start):
        low_runs = runs_of(is_low[start:end], blocks.is_start[start:end])
        longest_low = max((stop - begin for begin, stop in low_runs), default=0)
        if longest_low * BLOCK_S >= MIN_REST_S and not _is_descent(log, blocks, is_low, start, end):
            is_ground[start:end] = True
    if not is_ground.any():
        return is_ground[blocks.of_row]
    # Adjacent blocks have a part of the take-off or landing, where legs carry some of the weight.
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


def _is_descent(log: FlightLog, blocks: _Blocks, is_low: np.ndarray, start: int, end: int) -> bool:
    """Return whether the craft gained downward speed, without an impact, before its rest at 1 g.

    Args:
        log: of the blocks.
        blocks: of the log.
        is_low: blocks at low thrust, (num_blocks,) bool; the fall is within the run of them that
            leads to rest.
        start: first block at rest.
        end: block after the last one at rest.
    """
    if "f" not in log or "w" not in log:
        return False  # the velocity has shown already that the craft does not move
    first_low = start
    while first_low > 0 and is_low[first_low - 1] and not blocks.is_start[first_low]:
        first_low -= 1
    if first_low > 0 and not blocks.is_start[first_low]:
        first_low -= 1  # thrust may end within this block
    fall_start, rest_start, rest_end = np.searchsorted(blocks.of_row, [first_low, start, end])
    fall_start += np.searchsorted(
        log.time[fall_start:rest_start], log.time[rest_start] - MAX_FALL_S
    )
    if (
        rest_start - fall_start < 2
        or np.linalg.norm(log["f"][fall_start:rest_start], axis=1).max() > MAX_FALL_FORCE * GRAVITY
    ):
        return False
    at_rest = log["f"][rest_start:rest_end].mean(axis=0)
    up = at_rest / np.linalg.norm(at_rest)
    time = log.time[fall_start : rest_start + 1]
    stride = max(1, int(FALL_STEP_S * (rest_start - fall_start) / (time[-1] - time[0])))
    index = np.append(np.arange(0, rest_start - fall_start, stride), rest_start - fall_start)
    steps = np.diff(time[index])
    rotations = Rotation.from_rotvec(log["w"][fall_start + index[:-1]] * steps[:, None])
    # Integrate backwards from the rest, in whose frame "up" is known.
    rotation_to_rest, velocity_change = Rotation.identity(), 0.0
    for k in range(len(steps) - 1, -1, -1):
        rotation_to_rest = rotations[k] * rotation_to_rest
        force = rotation_to_rest.inv().apply(log["f"][fall_start + index[k]])
        velocity_change += steps[k] * (force @ up - GRAVITY)
    return bool(velocity_change < -MIN_FALL_SPEED)
