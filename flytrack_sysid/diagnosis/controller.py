"""The controller between sticks and motors, as a linear loop of body rates with delays.

A log of motors that holds the sticks, too, asks two questions: what the body makes of the motors
(the diagnosis), and what the controller makes of sticks and gyro. Per axis, the share of the motors
that turns the craft is

    P (full_stick s - w) + I integral(full_stick s - w) + F ds/dt - D dw/dt

where sticks s and rates w are each read some milliseconds earlier. This is the parallel form of a
PID controller with feedforward (Astrom and Hagglund, "Advanced PID Control", 2006, chapter 3). It
is linear in its coefficients for given delays, and these are searched on a grid. Motors at an end
of their range do not follow the law, and slow drifts (a relaxed integral, a battery that empties)
are no part of it: such rows and frequencies are left out.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.motors import NAMES, SIGNS
from flytrack_sysid.diagnosis.result import TWO_SIDED_95, Controller, Estimated, Loop
from flytrack_sysid.kinematics import derivative, low_pass
from flytrack_sysid.log import FlightLog, median_step
from flytrack_sysid.split import cut_evenly

AXES = ("roll", "pitch", "yaw")
# Between these time constants signals count, s: below, D terms have filters of their own, and above
# integrals are relaxed and thrust is compensated for the battery.
SLOWEST_S, FASTEST_S = 0.5, 0.004
MAX_DELAY_S, MIN_DELAY_STEP_S = 0.05, 0.002  # of the grid
NUM_SWEEPS = 3  # over both delays in turn; the second one changes a delay by one step at most
END_SHARE = 0.005  # of the range of all motors: that close to its ends, a motor is at one
AFTER_END_S = 0.05  # rows after an end that do not count: filters remember it
BLOCK_S = 1.0  # longer than what one error lasts; blocks count as independent
PERCENT_PER_100_DEG = 50.0 * float(np.deg2rad(100.0))  # a command of 2 is the whole range
# Of the stated rate at full stick. On two logs of right controllers, and on six parts of one of
# them, it came out up to 15 % off beyond its interval (docs/results/motors.md).
FULL_STICK_TOLERANCE = 0.2
# Of a log: delays of rate loops are 2 to 8 ms, and slower logs give wrong rates at full stick.
MAX_STEP_S = 0.005
MIN_BLOCKS = 8  # a covariance of six coefficients needs more blocks than that


def controller_notes(log: FlightLog) -> list[str]:
    """Return a note if a log has sticks beside motors, too slowly for the loop between them."""
    step_s = median_step(log)
    if not _shows_controller(log) or step_s <= MAX_STEP_S:
        return []
    return [
        f"{log.source}: the controller between sticks and motors is not examined: found a row each "
        f"{1e3 * step_s:.3g} ms, expected {1e3 * MAX_STEP_S:g} ms or less"
    ]


def examine_controller(
    log: FlightLog, model: ModelParameters, held_out: np.ndarray
) -> Controller | None:
    """Return the controller of a log; None if the log shows no axis of it.

    Arguments are those of ``identify_loops``.
    """
    loops = identify_loops(log, model, held_out)
    if not loops:
        return None
    stated = dict(zip(AXES, np.asarray(model.max_rate, float), strict=True))
    return Controller(loops, tuple(text for loop in loops for text in _faults(loop, stated)))


def _faults(loop: Loop, stated_deg_s: Mapping[str, float]) -> list[str]:
    """Return what contradicts that a loop stops turns and asks for the stated rates, by axis."""
    full_stick, stated = loop.full_stick, float(stated_deg_s[loop.axis])
    if loop.gain.ci95[1] < 0.0:
        return [f"{loop.axis}: the motors push a turn on, expected them to stop it"]
    return _difference(loop.axis, full_stick, Estimated(stated, (stated, stated), "deg/s"))


def changes(later: Controller | None, earlier: Controller | None) -> list[str]:
    """Return a sentence for each axis whose rate at full stick has changed since an earlier log."""
    before = {} if earlier is None else {loop.axis: loop.full_stick for loop in earlier.loops}
    loops = [] if later is None else [loop for loop in later.loops if loop.axis in before]
    return [
        text
        for loop in loops
        for text in _difference(loop.axis, loop.full_stick, before[loop.axis])
    ]


def _difference(axis: str, full_stick: Estimated, expected: Estimated) -> list[str]:
    difference = abs(full_stick.value - expected.value)
    half_width = float(np.hypot(full_stick.half_width, expected.half_width))
    if difference <= max(half_width, FULL_STICK_TOLERANCE * abs(expected.value)):
        return []
    return [
        f"{axis}: full stick asks for {full_stick.value:.0f} ± {full_stick.half_width:.0f} deg/s, "
        f"expected {expected.value:.0f}"
    ]


def _shows_controller(log: FlightLog) -> bool:
    return log.has_motors and {"sticks", "w"} <= set(log.channels)


def identify_loops(
    log: FlightLog, model: ModelParameters, held_out: np.ndarray
) -> tuple[Loop, ...]:
    """Return the loops of roll, pitch and yaw; none of an axis that the log does not show.

    Args:
        log: of motors, at its full rate; nothing is returned without sticks or a gyro, or if it
            is too slow.
        model: of motors; the sense in which its propellers turn counts.
        held_out: rows for testing, (num_rows,) bool.
    """
    step_s = median_step(log)
    if not _shows_controller(log) or step_s > MAX_STEP_S:
        return ()
    rows = _Rows.of(log, held_out, step_s)
    turn = np.sign(float(model.effect("motors").yaw_arm)) or 1.0
    signs = SIGNS * np.array([[1.0], [1.0], [turn]])
    shares = _filtered(log["u"] @ signs.T / len(NAMES), step_s)
    loops = []
    for axis, axis_name in enumerate(AXES):
        sticks, gyro = (_Signal.of(log, log[name][:, axis], step_s) for name in ("sticks", "w"))
        loop = _loop(axis_name, shares[:, axis], sticks, gyro, rows)
        loops += [loop] if loop is not None else []
    return tuple(loops)


class _Signal(NamedTuple):
    """A signal, its slope and its integral, all filtered, (num_rows, 3)."""

    parts: np.ndarray
    step_s: float

    @classmethod
    def of(cls, log: FlightLog, values: np.ndarray, step_s: float) -> "_Signal":
        """Return the parts of a signal, (num_rows,), of a log."""
        slopes, integral = derivative(log, values[:, None])[:, 0], np.cumsum(values) * step_s
        return cls(_filtered(np.stack([values, slopes, integral], axis=1), step_s), step_s)

    def before(self, rows: np.ndarray, delay_s: float) -> np.ndarray:
        """Return the parts some seconds before rows, (len(rows), 3)."""
        return self.parts[np.maximum(rows - round(delay_s / self.step_s), 0)]


class _Rows(NamedTuple):
    """Numbers of the rows that are fitted and held out, and the block of each fitted one."""

    fitted: np.ndarray
    held_out: np.ndarray
    block: np.ndarray

    @classmethod
    def of(cls, log: FlightLog, held_out: np.ndarray, step_s: float) -> "_Rows":
        """Return the rows of a log.

        Rows after a motor's end and after the start of a segment do not count, and no more rows
        than filtered signals need.
        """
        low, high = log["u"].min(), log["u"].max()
        margin = END_SHARE * (high - low)
        is_at_end = ((log["u"] <= low + margin) | (log["u"] >= high - margin)).any(axis=1)
        is_start = log.is_start()
        counts = ~_follows(is_at_end, AFTER_END_S / step_s)
        counts &= ~_follows(is_start, SLOWEST_S / step_s)
        counts &= np.arange(len(log)) % max(round(FASTEST_S / step_s), 1) == 0
        fitted = np.flatnonzero(counts & ~held_out)
        block = cut_evenly(log.time, is_start, BLOCK_S)[fitted]
        return cls(fitted, np.flatnonzero(counts & held_out), block)


class _Fit(NamedTuple):
    """Coefficients of six regressors, by least squares.

    Attributes:
        coefficients: (6,), of sticks, their slope and integral, and the same of the gyro.
        design: the regressors in the fitted rows, (num_rows, 6).
        errors: what is left there, (num_rows,).
    """

    coefficients: np.ndarray
    design: np.ndarray
    errors: np.ndarray

    def covariance(self, block: np.ndarray) -> np.ndarray:
        """Return the covariance of the coefficients if errors of different blocks are independent.

        Source: Liang and Zeger, Biometrika 1986 (clustered sandwich estimate).
        """
        _, number = np.unique(block, return_inverse=True)
        scores = np.zeros((number.max() + 1, self.design.shape[1]))
        np.add.at(scores, number, self.design * self.errors[:, None])
        bread = np.linalg.pinv(self.design.T @ self.design)
        return np.asarray(bread @ scores.T @ scores @ bread)


def _filtered(values: np.ndarray, step_s: float) -> np.ndarray:
    """Return the part of signals, (num_rows, ...), that is neither too slow nor too fast."""
    fast = values - low_pass(values, step_s, SLOWEST_S)
    return low_pass(low_pass(fast, step_s, FASTEST_S), step_s, FASTEST_S)


def _follows(is_event: np.ndarray, num_rows: float) -> np.ndarray:
    """Return the rows at an event or up to a number of rows after one, (num_rows,) bool."""
    row = np.arange(len(is_event))
    last = np.maximum.accumulate(np.where(is_event, row, -len(row) - 1))
    return row - last <= num_rows


def _loop(axis: str, share: np.ndarray, sticks: _Signal, gyro: _Signal, rows: _Rows) -> Loop | None:
    """Return the loop of an axis; None if the log does not show it."""
    if len(np.unique(rows.block)) < MIN_BLOCKS or not np.ptp(sticks.parts[rows.fitted, 0]):
        return None

    def design(of: np.ndarray, stick_s: float, gyro_s: float) -> np.ndarray:
        return np.concatenate([sticks.before(of, stick_s), gyro.before(of, gyro_s)], axis=1)

    def fit(stick_s: float, gyro_s: float) -> _Fit:
        regressors = design(rows.fitted, stick_s, gyro_s)
        # By normal equations, ten times as fast here as an orthogonal factorisation.
        size = np.linalg.norm(regressors, axis=0)
        scaled = regressors / np.where(size > 0.0, size, 1.0)
        coefficients = np.linalg.pinv(scaled.T @ scaled) @ (scaled.T @ share[rows.fitted]) / size
        return _Fit(coefficients, regressors, share[rows.fitted] - regressors @ coefficients)

    def misfit(stick_s: float, gyro_s: float) -> float:
        return float(np.sum(fit(stick_s, gyro_s).errors ** 2))

    delays_s = np.arange(0.0, MAX_DELAY_S, max(sticks.step_s, MIN_DELAY_STEP_S)).tolist()
    stick_s = gyro_s = 0.0
    for _ in range(NUM_SWEEPS):
        gyro_s = min(delays_s, key=lambda delay_s: misfit(stick_s, delay_s))
        stick_s = min(delays_s, key=lambda delay_s: misfit(delay_s, gyro_s))
    best = fit(stick_s, gyro_s)
    coefficients, covariance = best.coefficients, best.covariance(rows.block)

    def ratio(over: int, under: int, factor: float, unit: str) -> Estimated:
        """Return a ratio of coefficients; its uncertainty is to first order."""
        value = coefficients[over] / coefficients[under]
        slope = np.zeros(len(coefficients))
        slope[over], slope[under] = np.array([1.0, -value]) / coefficients[under]
        half = TWO_SIDED_95 * abs(factor) * np.sqrt(slope @ covariance @ slope)
        return Estimated.around(float(factor * value), float(half), unit)

    stick, stick_slope, _, rate, rate_slope, rate_integral = range(len(coefficients))
    half = TWO_SIDED_95 * PERCENT_PER_100_DEG * np.sqrt(covariance[rate, rate])
    gain = -PERCENT_PER_100_DEG * coefficients[rate]
    held_out = share[rows.held_out]
    errors = held_out - design(rows.held_out, stick_s, gyro_s) @ coefficients
    return Loop(
        axis=axis,
        explained=1.0 - float(np.var(errors) / np.var(held_out)) if len(held_out) else np.nan,
        full_stick=ratio(stick, rate, -float(np.rad2deg(1.0)), "deg/s"),
        gain=Estimated.around(float(gain), float(half), "% per 100 deg/s"),
        integral=ratio(rate_integral, rate, 1.0, "1/s"),
        derivative=ratio(rate_slope, rate, 1.0, "s"),
        feedforward=ratio(stick_slope, stick, 1.0, "s"),
        stick_delay_s=stick_s,
        gyro_delay_s=gyro_s,
    )
