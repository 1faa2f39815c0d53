"""The controller between sticks and motors, as a linear loop of body rates with delays.

A log of motors that holds the sticks, too, asks two questions: what the body makes of the motors
(the diagnosis), and what the controller makes of sticks and gyro. Per axis, the demand of torque,
a weighted mean of the motors, is

    P (full_stick s - w) + I integral(full_stick s - w) + F ds/dt - D dw/dt

where sticks s and rates w are each read some milliseconds earlier. This is the parallel form of a
PID controller with feedforward (Astrom and Hagglund, "Advanced PID Control", 2006, chapter 3). It
is linear in its coefficients for given delays, and these are searched on a grid. Motors at an end
of their range do not follow the law, and slow drifts (a relaxed integral, a battery that empties)
are no part of it: such rows and frequencies are left out.
"""

from typing import NamedTuple

import numpy as np
from scipy import stats

from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.motors import NAMES, SIGNS
from flytrack_sysid.diagnosis.result import Controller, Estimated, RateLoop
from flytrack_sysid.kinematics import low_pass
from flytrack_sysid.log import FlightLog, usual_step
from flytrack_sysid.log_file import gaps_of
from flytrack_sysid.split import cut_evenly

AXES = ("roll", "pitch", "yaw")
# Between these time constants signals count, s: below, D terms have filters of their own, and above
# integrals are relaxed and thrust is compensated for the battery.
SLOWEST_S, FASTEST_S = 0.5, 0.004
MAX_DELAY_S, MIN_DELAY_STEP_S = 0.05, 0.002  # of the grid
END_SHARE = 0.005  # of the range of all motors: that close to its ends, a motor is at one
AFTER_END_S = 0.05  # rows after an end that do not count: filters remember it
BLOCK_S = 1.0  # longer than what one error lasts; blocks count as independent
MIN_BLOCKS = 8  # a covariance of six coefficients needs more blocks than that
PERCENT_PER_100_DEG = 50.0 * float(np.deg2rad(100.0))  # a command of 2 is the whole range
# Of the expected rate at full stick. On two logs of right controllers, and on six parts of one of
# them, it came out up to 12 % off (docs/results/motors.md); no other log judged this bound.
FULL_STICK_TOLERANCE = 0.2
# Between rows, and between changes of motors and of sticks: delays of rate loops are 2 to 8 ms.
MAX_STEP_S = 0.005
MAX_STEP_RATIO = 1.1  # of the steps of a log's segments: delays and filters are in steps


def controller_notes(log: FlightLog, held_out: np.ndarray) -> list[str]:
    """Return why the controller of a log with sticks beside motors is not examined, if so.

    Args:
        log: of motors.
        held_out: rows for testing, (num_rows,) bool.
    """
    if not _has_both_sides(log):
        return []
    problem = _unsuitable_steps(log)
    if not problem and _count_blocks(_Rows.of(log, held_out)) < MIN_BLOCKS:
        problem = (
            f"found fewer than {MIN_BLOCKS} blocks of {BLOCK_S:g} s in which no motor is at an end"
        )
    return [f"{log.source}: the controller is not examined: {problem}"] if problem else []


def examine_controller(
    log: FlightLog, model: ModelParameters, held_out: np.ndarray
) -> Controller | None:
    """Return the controller of a log; None if the log shows no axis of it.

    Args:
        log: of motors, at its full rate.
        model: of motors. Its rates at full stick are compared, unless they are the nominal ones,
            which a model has that nobody stated any for.
        held_out: rows for testing, (num_rows,) bool.
    """
    loops = identify_loops(log, model, held_out)
    if not loops:
        return None
    stated_deg_s = np.asarray(model.max_rate, float)
    is_stated = not np.array_equal(stated_deg_s, np.asarray(nominal_parameters().max_rate, float))
    faults: list[str] = []
    for loop in loops:
        rate = float(stated_deg_s[AXES.index(loop.axis)])
        expected = Estimated(rate, (rate, rate), "deg/s")
        faults += _wrong_sense(loop) or (_other_full_stick(loop, expected) if is_stated else [])
    return Controller(loops, tuple(faults))


def compare_controllers(
    later: Controller | None, earlier: Controller | None
) -> tuple[Controller | None, list[str]]:
    """Return the later controller with its changes since an earlier log as faults, and notes.

    Only axes that both logs show are compared.
    """
    if later is None:
        return None, []
    before = {} if earlier is None else {loop.axis: loop for loop in earlier.loops}
    loops = tuple(loop for loop in later.loops if loop.axis in before)
    faults: list[str] = []
    for loop in loops:
        faults += _wrong_sense(loop) or _other_full_stick(loop, before[loop.axis].full_stick)
    controller = Controller(loops, tuple(faults)) if loops else None
    missing = ", ".join(loop.axis for loop in later.loops if loop.axis not in before)
    if not missing:
        return controller, []
    return controller, [f"controller: {missing}: not compared: the earlier log does not show it"]


def identify_loops(
    log: FlightLog, model: ModelParameters, held_out: np.ndarray
) -> tuple[RateLoop, ...]:
    """Return the loops of roll, pitch and yaw; none of an axis that the log does not show.

    Args:
        log: of motors, at its full rate; nothing is returned without sticks or a gyro, or if it
            is too slow.
        model: of motors; the sense in which its propellers turn counts.
        held_out: rows for testing, (num_rows,) bool.
    """
    if not _has_both_sides(log) or _unsuitable_steps(log):
        return ()
    rows = _Rows.of(log, held_out)
    if _count_blocks(rows) < MIN_BLOCKS:
        return ()
    turn = np.sign(float(model.effect("motors").yaw_arm)) or 1.0
    signs = SIGNS * np.array([[1.0], [1.0], [turn]])
    demands = _Signal.of(log, log["u"] @ signs.T / len(NAMES)).values
    sticks, gyro = (_Signal.of(log, log[name][:, :3]) for name in ("sticks", "w"))
    loops = []
    for axis, name in enumerate(AXES):
        is_moved = all(np.ptp(log[channel][rows.fitted, axis]) > 0.0 for channel in ("sticks", "w"))
        if is_moved:
            loops.append(
                _loop(name, demands[:, axis], sticks.of_axis(axis), gyro.of_axis(axis), rows)
            )
    return tuple(loops)


def _has_both_sides(log: FlightLog) -> bool:
    return log.has_motors and {"sticks", "w"} <= set(log.channels)


def _unsuitable_steps(log: FlightLog) -> str:
    """Return what is wrong with a log's steps, found and expected; empty if nothing is."""
    steps_s = usual_step(log)
    if steps_s.max() > MAX_STEP_RATIO * steps_s.min():
        return f"found steps of {steps_s.min():.3g} to {steps_s.max():.3g} s, expected equal ones"
    for name, words in (("", "a row"), ("u", "other motors"), ("sticks", "other sticks")):
        step_s = _time_between_changes(log, name) if name else float(steps_s[0])
        if step_s > MAX_STEP_S:
            expected = f"expected {1e3 * MAX_STEP_S:g} ms or less"
            return f"found {words} each {1e3 * step_s:.3g} ms, {expected}"
    return ""


def _time_between_changes(log: FlightLog, channel: str) -> float:
    """Return the usual time after which a channel that moves has another value, s."""
    values = log[channel]
    is_changed = np.append(True, (values[1:] != values[:-1]).any(axis=1))
    times = log.time[is_changed]
    return float(np.median(np.diff(times))) if len(times) > 1 else 0.0


def _pieces(log: FlightLog) -> list[np.ndarray]:
    """Return the rows of each piece of flight; a segment or a gap begins a new one."""
    is_first = log.is_start()
    is_first[gaps_of(log) + 1] = True
    return np.split(np.arange(len(log)), np.flatnonzero(is_first)[1:])


class _Signal(NamedTuple):
    """Signals, their slopes and their integrals, filtered within each piece of flight.

    Attributes:
        values: (num_rows, num_signals), as are the others.
        slopes: a second.
        integrals: s.
        step_s: between rows, s.
    """

    values: np.ndarray
    slopes: np.ndarray
    integrals: np.ndarray
    step_s: float

    @classmethod
    def of(cls, log: FlightLog, signals: np.ndarray) -> "_Signal":
        """Return the parts of signals, (num_rows, num_signals), of a log."""
        step_s = float(np.median(usual_step(log)))
        parts = np.zeros((3, *signals.shape))
        for rows in _pieces(log):
            values = signals[rows]
            slopes = np.gradient(values, step_s, axis=0) if len(rows) > 1 else 0.0 * values
            for number, part in enumerate((values, slopes, np.cumsum(values, axis=0) * step_s)):
                parts[number, rows] = _filtered(part - part[0], step_s)  # filters begin at rest
        return cls(parts[0], parts[1], parts[2], step_s)

    def of_axis(self, axis: int) -> "_Signal":
        """Return the parts of one signal, (num_rows,)."""
        values, slopes, integrals = (
            part[:, axis] for part in (self.values, self.slopes, self.integrals)
        )
        return _Signal(values, slopes, integrals, self.step_s)

    def before(self, rows: np.ndarray, delay_s: float) -> np.ndarray:
        """Return the parts of one signal some seconds before rows, (len(rows), 3)."""
        earlier = np.maximum(rows - round(delay_s / self.step_s), 0)
        parts = (self.values, self.slopes, self.integrals)
        return np.stack([part[earlier] for part in parts], axis=1)


class _Rows(NamedTuple):
    """Numbers of the rows that are fitted and held out, and the block of each fitted one."""

    fitted: np.ndarray
    held_out: np.ndarray
    block: np.ndarray

    @classmethod
    def of(cls, log: FlightLog, held_out: np.ndarray) -> "_Rows":
        """Return the rows of a log.

        Rows after a motor's end and at the start of a piece of flight do not count, and no more
        rows than filtered signals need.
        """
        step_s = float(np.median(usual_step(log)))
        low, high = log["u"].min(), log["u"].max()
        margin = END_SHARE * (high - low)
        is_at_end = ((log["u"] <= low + margin) | (log["u"] >= high - margin)).any(axis=1)
        counts = ~_follows(is_at_end, AFTER_END_S / step_s)
        is_first = np.zeros(len(log), bool)
        is_first[[rows[0] for rows in _pieces(log)]] = True
        counts &= ~_follows(is_first, SLOWEST_S / step_s)
        counts &= np.arange(len(log)) % max(round(FASTEST_S / step_s), 1) == 0
        fitted = np.flatnonzero(counts & ~held_out)
        block = cut_evenly(log.time, is_first, BLOCK_S)[fitted]
        return cls(fitted, np.flatnonzero(counts & held_out), block)


def _count_blocks(rows: _Rows) -> int:
    return len(np.unique(rows.block))


class _Fit(NamedTuple):
    """Coefficients of six regressors, by least squares.

    Attributes:
        coefficients: (6,), of the stick, its slope and integral, and the same of the gyro.
        size: of the regressors, (6,).
        scaled: the regressors of the fitted rows over their size, (num_rows, 6).
        errors: what is left there, (num_rows,).
    """

    coefficients: np.ndarray
    size: np.ndarray
    scaled: np.ndarray
    errors: np.ndarray

    @classmethod
    def of(cls, regressors: np.ndarray, demand: np.ndarray) -> "_Fit":
        """Return the fit, by normal equations: ten times as fast here as a factorisation."""
        size = np.linalg.norm(regressors, axis=0)
        size = np.where(size > 0.0, size, 1.0)
        scaled = regressors / size
        solution = np.linalg.pinv(scaled.T @ scaled) @ (scaled.T @ demand)
        return cls(solution / size, size, scaled, demand - scaled @ solution)

    def covariance(self, block: np.ndarray) -> np.ndarray:
        """Return the covariance of the coefficients if errors of different blocks are independent.

        Source: Liang and Zeger, Biometrika 1986 (clustered sandwich estimate).
        """
        _, number = np.unique(block, return_inverse=True)
        scores = np.zeros((number.max() + 1, len(self.size)))
        np.add.at(scores, number, self.scaled * self.errors[:, None])
        bread = np.linalg.pinv(self.scaled.T @ self.scaled)
        return np.asarray(bread @ scores.T @ scores @ bread / np.outer(self.size, self.size))


def _filtered(values: np.ndarray, step_s: float) -> np.ndarray:
    """Return the part of signals, (num_rows, ...), that is neither too slow nor too fast."""
    fast = values - low_pass(values, step_s, SLOWEST_S)
    return low_pass(low_pass(fast, step_s, FASTEST_S), step_s, FASTEST_S)


def _follows(is_event: np.ndarray, num_rows: float) -> np.ndarray:
    """Return the rows at an event or up to a number of rows after one, (num_rows,) bool."""
    row = np.arange(len(is_event))
    last = np.maximum.accumulate(np.where(is_event, row, -len(row) - 1))
    return row - last <= num_rows


def _best_delays(
    stick: _Signal, gyro: _Signal, demand: np.ndarray, rows: np.ndarray
) -> tuple[float, float]:
    """Return the delays of stick and gyro, s, of the grid with which both explain a demand best.

    All pairs share one matrix of inner products. Searches of one delay after the other end early,
    since a delay and a slope nearly replace each other.
    """
    delays_s = np.arange(0.0, MAX_DELAY_S, max(stick.step_s, MIN_DELAY_STEP_S)).tolist()
    columns = np.concatenate(
        [signal.before(rows, delay_s) for signal in (stick, gyro) for delay_s in delays_s], axis=1
    )
    size = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(size > 0.0, size, 1.0)
    products, moments = columns.T @ columns, columns.T @ demand[rows]

    def explained(pair: tuple[int, int]) -> float:
        first = 3 * np.array([pair[0], len(delays_s) + pair[1]])
        chosen = (first[:, None] + np.arange(3)).ravel()
        inverse = np.linalg.pinv(products[np.ix_(chosen, chosen)], hermitian=True)
        return float(moments[chosen] @ inverse @ moments[chosen])

    numbers = range(len(delays_s))
    stick_number, gyro_number = max(
        [(first, second) for first in numbers for second in numbers], key=explained
    )
    return delays_s[stick_number], delays_s[gyro_number]


def _loop(axis: str, demand: np.ndarray, stick: _Signal, gyro: _Signal, rows: _Rows) -> RateLoop:
    """Return the loop of an axis.

    Args:
        axis: its name.
        demand: filtered, (num_rows,).
        stick: of the axis.
        gyro: of the axis.
        rows: at least ``MIN_BLOCKS`` blocks.
    """

    def regressors(at: np.ndarray, stick_s: float, gyro_s: float) -> np.ndarray:
        return np.concatenate([stick.before(at, stick_s), gyro.before(at, gyro_s)], axis=1)

    stick_s, gyro_s = _best_delays(stick, gyro, demand, rows.fitted)
    best = _Fit.of(regressors(rows.fitted, stick_s, gyro_s), demand[rows.fitted])
    coefficients, covariance = best.coefficients, best.covariance(rows.block)
    quantile = float(stats.t.ppf(0.975, _count_blocks(rows) - len(coefficients)))

    def estimated(value: float, slope: np.ndarray, unit: str) -> Estimated:
        half = quantile * np.sqrt(slope @ covariance @ slope)
        return Estimated.around(float(value), float(half), unit)

    def ratio(over: int, under: int, factor: float, unit: str) -> Estimated:
        """Return a ratio of coefficients; its uncertainty is to first order."""
        divisor = coefficients[under] or np.nan
        value, slope = coefficients[over] / divisor, np.zeros(len(coefficients))
        slope[over], slope[under] = 1.0 / divisor, -value / divisor
        return estimated(factor * value, factor * slope, unit)

    of_stick, of_stick_slope, _, of_rate, of_rate_slope, of_rate_integral = range(6)
    to_percent = np.zeros(len(coefficients))
    to_percent[of_rate] = -PERCENT_PER_100_DEG
    held_out = demand[rows.held_out]
    errors = held_out - regressors(rows.held_out, stick_s, gyro_s) @ coefficients
    has_variance = len(held_out) > 0 and np.ptp(held_out) > 0.0
    return RateLoop(
        axis=axis,
        explained=1.0 - float(np.var(errors) / np.var(held_out)) if has_variance else np.nan,
        full_stick=ratio(of_stick, of_rate, -float(np.rad2deg(1.0)), "deg/s"),
        gain=estimated(to_percent @ coefficients, to_percent, "% per 100 deg/s"),
        integral=ratio(of_rate_integral, of_rate, 1.0, "1/s"),
        derivative=ratio(of_rate_slope, of_rate, 1.0, "s"),
        feedforward=ratio(of_stick_slope, of_stick, 1.0, "s"),
        stick_delay_s=stick_s,
        gyro_delay_s=gyro_s,
    )


def _wrong_sense(loop: RateLoop) -> list[str]:
    if loop.gain.ci95[1] >= 0.0:
        return []
    return [f"{loop.axis}: the motors push a turn on, expected them to stop it"]


def _other_full_stick(loop: RateLoop, expected: Estimated) -> list[str]:
    """Return how full stick differs from an expected rate; nothing where P may be 0."""
    full_stick = loop.full_stick
    half_width = float(np.hypot(full_stick.half_width, expected.half_width))
    tolerance = max(half_width, FULL_STICK_TOLERANCE * abs(expected.value))
    if loop.gain.ci95[0] <= 0.0 or not abs(full_stick.value - expected.value) > tolerance:
        return []
    return [
        f"{loop.axis}: full stick asks for {full_stick.value:.0f} ± {full_stick.half_width:.0f} "
        f"deg/s, expected {expected.value:.0f}"
    ]
