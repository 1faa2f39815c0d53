"""Sensors that are late against each other.

A channel is moved in time until it agrees best with the others over windows. What is gained is a
log-likelihood, as in ``motion``; a sensor cannot be early, so of two that differ the one that shows
the motion later is late. A jackknife over blocks gives the standard error (Efron and Tibshirani, An
Introduction to the Bootstrap, 1993, chapter 11).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_sysid.check.explain import Change
from flytrack_sysid.check.motion import MARGIN, useful_windows, weight_of
from flytrack_sysid.clocks import offset_between
from flytrack_sysid.kinematics import WEIGHT_W, attitude_of, jackknife_error, read_at, summed_turns
from flytrack_sysid.log import FlightLog, median_step

LATE_S = 0.006  # smaller offsets are those of filters and of the log's step
MAX_LATE_S, GRID_S = 0.1, 0.005
BLOCK_S, LATE_ERRORS = 2.0, 5.0  # of the jackknife; standard errors
# Clocks have to be apart by so many standard errors, and by this share of the move: a clean log of
# the black box had a move of 13 ms, and clocks 3 ms apart.
CLOCK_ERRORS, CLOCK_SHARE = 3.0, 0.5
# Nats where clocks cannot be compared: a clean flight among 85 gained 11.6, sensors that are late
# 11.3 in one flight and 13.6 to 232 in 13 others.
ALONE = 13.0
TINY = 1e-12
MIN_S = 10.0  # of flight: less may show an estimator's errors
MIN_EXPLAINED = 0.9  # share of the changes that the integrals explain when they agree best


class Shift(NamedTuple):
    """A move in time by which channels agree best.

    Attributes:
        seconds: how late the moved channel is; 0 where nothing is gained.
        nats: of log-likelihood that are gained.
    """

    seconds: float
    nats: float


NOTHING = Shift(0.0, 0.0)


def best_shift(
    log: FlightLog,
    sums: np.ndarray,
    rates: Callable[[float], np.ndarray],
    is_rate: bool = False,
) -> Shift:
    """Return the move by which changes of a quantity agree best with integrals of its derivative.

    The derivative is moved: interpolation between samples of the quantity would smooth its noise.

    Args:
        log: the log that holds the rows.
        sums: the quantity, (num_rows, 3).
        rates: returns the derivative with a channel moved by some seconds, and regressors of what
            it may be off by, (num_rows, 3, 1 + number of regressors).
        is_rate: whether positive seconds mean that the derivative is late, not the quantity.
    """
    best = NOTHING
    # A simulator's rates may be those of half a step before.
    half_step_s = 0.5 * median_step(log) if log.origin == "simulated" else 0.0
    least_s = LATE_S + half_step_s
    grid = np.arange(-MAX_LATE_S, MAX_LATE_S + GRID_S / 2, GRID_S)
    features = [rates(seconds).reshape(len(log), -1) for seconds in grid]
    for length_s, windows in useful_windows(log):
        elapsed_s = np.cumsum(windows.durations)
        if elapsed_s[-1] < MIN_S:
            continue
        shown = windows.mean_rate(sums)
        block = (elapsed_s / BLOCK_S).astype(int)
        residuals = np.array(
            [
                _residuals(shown, windows.mean_of(log, flat).reshape(*shown.shape, -1), block)
                for flat in features
            ]
        )  # (num_grid, num_blocks, 3)
        totals = residuals.sum(axis=1)
        seconds, least = _lowest(grid, np.log(totals + TINY).sum(axis=1))
        if totals.sum(axis=1).min() > (1.0 - MIN_EXPLAINED) * np.sum(shown**2):
            continue
        without = np.log(totals[:, None] - residuals + TINY).sum(axis=2)  # one block
        sigma_s = jackknife_error(np.array([_lowest(grid, costs)[0] for costs in without.T]))
        at_zero = float(np.log(totals[len(grid) // 2] + TINY).sum())
        nats = 0.5 * weight_of(length_s) * len(shown) * (at_zero - least)
        if nats > best.nats and abs(seconds) > max(least_s, LATE_ERRORS * sigma_s):
            best = Shift(seconds, nats)
    if best.nats < MARGIN:
        return NOTHING
    # The comparison of clocks, by which an import corrects them, must not be against it.
    offset_s, sigma_s, _, unknown = offset_between(log, sums, rates(0.0)[:, :, 0])
    towards = np.sign(best.seconds) * (-offset_s if is_rate else offset_s)
    least_s = max(CLOCK_ERRORS * sigma_s, CLOCK_SHARE * abs(best.seconds))
    is_late = best.nats > ALONE if unknown else towards > least_s
    return best if is_late else NOTHING


def _residuals(shown: np.ndarray, means: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Return squared differences, (num_blocks, 3), without what regressors explain.

    Args:
        shown: (num_windows, 3).
        means: what should equal it, and regressors, (num_windows, 3, 1 + number of regressors).
        block: of each window, (num_windows,).
    """
    left = shown - means[:, :, 0]
    errors = means[:, :, 1:].reshape(left.size, -1)
    if errors.size:
        weights = np.linalg.pinv(errors.T @ errors) @ (errors.T @ left.ravel())
        left = left - (errors @ weights).reshape(left.shape)
    return np.stack([np.bincount(block, axis**2) for axis in left.T], axis=1)


def _lowest(grid: np.ndarray, costs: np.ndarray) -> tuple[float, float]:
    """Return where costs on a grid are lowest, by a parabola through three of them, and how low."""
    row = int(np.clip(np.argmin(costs), 1, len(grid) - 2))
    before, here, after = costs[row - 1 : row + 2]
    bend = before - 2.0 * here + after
    if bend <= 0.0:
        return float(grid[row]), float(here)
    place = float(np.clip(0.5 * (before - after) / bend, -1.0, 1.0))
    return float(grid[row] + place * GRID_S), float(here - 0.125 * (before - after) ** 2 / bend)


def late_sensors(log: FlightLog) -> list[Change]:
    """Return the sensors that are late; the log has right axes and scales."""
    late: dict[str, float] = {}
    attitude = attitude_of(log) if "q" in log else None
    if attitude is not None and "w" in log:
        turns = summed_turns(attitude)
        # A late attitude agrees with rates that are read earlier.
        shift = best_shift(log, turns, lambda late_s: read_at(log, log["w"], -late_s)[..., None])
        late["q" if shift.seconds > 0.0 else "w"] = abs(shift.seconds)
    position = velocity = force = NOTHING
    if "p" in log and "v" in log:
        position = best_shift(
            log, log["p"], lambda late_s: read_at(log, log["v"], -late_s)[..., None]
        )
    has_force = attitude is not None and "v" in log and "f" in log
    if has_force:
        quat = read_at(log, log["q"], late.get("q", 0.0))
        matrices = Rotation.from_quat(quat, scalar_first=True).as_matrix()
        of_world = accelerations(log["f"], matrices).reshape(len(log), -1)
        velocity = best_shift(
            log, log["v"], lambda late_s: read_at(log, of_world, -late_s).reshape(len(log), 3, -1)
        )
        force = best_shift(
            log,
            log["v"],
            lambda late_s: accelerations(read_at(log, log["f"], late_s), matrices),
            is_rate=True,
        )
    if velocity.nats >= force.nats and velocity.seconds > 0.0:
        late["v"] = velocity.seconds
    elif force.seconds > 0.0:
        late["f"] = force.seconds
    elif position.seconds < 0.0 and not has_force:
        late["v"] = -position.seconds
    # Beside a late velocity, a position on time seems early.
    late["p"] = position.seconds + late.get("v", 0.0)
    return [Change(name, "delay", seconds) for name, seconds in late.items() if seconds > LATE_S]


def accelerations(force: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """Return the acceleration by the accelerometer and what it may be off by, (num_rows, 3, 7).

    The regressors are a bias of the accelerometer and a small rotation of the body's axes.

    Args:
        force: specific force, (num_rows, 3) m/s^2.
        matrices: of the attitude, (num_rows, 3, 3).
    """
    turned = np.cross(np.eye(3)[None], force[:, None]).transpose(0, 2, 1)
    world = matrices @ force[..., None] - WEIGHT_W[:, None]
    return np.concatenate([world, matrices, matrices @ turned], axis=2)
