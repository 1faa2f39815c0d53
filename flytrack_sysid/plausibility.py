"""Plausibility of a log as a flight: units, gravity and signs, stuck columns, too little data.

Channels that measure the same motion are compared over windows of 0.1 to 1 s, so that noise
averages out. Where the motion is too small for a decision, no problem is reported.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import nominal_parameters
from flytrack_sysid.log import CHANNELS, FlightLog, LogError

WINDOWS_S = (0.1, 0.3, 1.0)  # long against the noise of a sample; short ones for fast manoeuvres
MIN_WINDOWS = 10
MIN_CORRELATION = 0.9  # below, the slope may be that of noise
# Channels of one motion that correlate by less contradict each other. Another reading resolves the
# contradiction if they then correlate by MIN_CORRELATION. Correct logs: 0.97 or more where the
# drone moves, any value where it does not.
CONTRADICTION = 0.5
STILL = 1e-6  # in any unit: a smaller change counts as none
GRAVITY = float(nominal_parameters().g)  # m/s^2
TOLERANCE = 0.15  # relative, of a known wrong factor; scale errors of sensors are well below it
MIN_ROWS = 100
MIN_UPRIGHT_ROWS = 20
MIN_S = 2.0
MAX_STEP_S = 0.5  # no log of a drone is as slow as 2 Hz
PER_S = {"ms": 1e3, "us": 1e6, "ns": 1e9}
MIN_TURN = 0.3  # rad within a second: more than the bias of a gyroscope at rest integrates to
FAST_PERCENTILE = 99.0  # of the rates: an isolated spike does not show a wrong unit
FASTEST_RATE = float(np.deg2rad(4000.0))  # rad/s, the widest range among common gyroscopes
HIGHEST_BATTERY_V = 100.0  # drones' batteries end at about 60 V
LIKELY_BATTERY_V = (2.5, 70.0)  # an empty cell; more than a full pack of 14 in series
MAX_FORCE_G = 3.0  # median specific force of a flight, in g; racing flights are below it
MAX_BIAS = 2.5  # m/s^2, of an accelerometer in flight, vibration included
LONG_FALL_S = 5.0  # no drone falls for longer
MIN_FORCE_DOWN = 0.5 * GRAVITY  # m/s^2 along -z of the body; drag in a fast climb is less
UPRIGHT = float(np.cos(np.deg2rad(45.0)))  # cosine of the tilt

BATTERY_UNITS = {1000.0: "mV", 100.0: "hundredths of V", 10.0: "tenths of V"}


class Windows(NamedTuple):
    """Windows of about the same length, none across segments or long gaps.

    Attributes:
        starts: first row, (num_windows,).
        ends: row after the last step, (num_windows,).
        durations: (num_windows,) s.
    """

    starts: np.ndarray
    ends: np.ndarray
    durations: np.ndarray

    def change_of(self, values: np.ndarray) -> np.ndarray:
        """Return the change of values, (num_rows, ...), over each window."""
        return values[self.ends] - values[self.starts]

    def mean_of(self, log: FlightLog, values: np.ndarray) -> np.ndarray:
        """Return the mean of values, (num_rows, n), over each window; linear between rows."""
        steps = np.diff(log.time)[:, None] * 0.5 * (values[1:] + values[:-1])
        integral = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])
        return self.change_of(integral) / self.durations[:, None]


def cut_windows(log: FlightLog, length_s: float) -> Windows:
    """Return the windows of a log, without those that a gap makes more than twice as long."""
    is_start = log.is_start()
    flight = np.cumsum(is_start) - 1
    since_start = log.time - log.time[is_start][flight]
    window = np.floor(since_start / length_s)
    edges = np.flatnonzero(is_start | np.append(True, np.diff(window) > 0))
    starts, ends = edges[:-1], edges[1:]
    durations = log.time[ends] - log.time[starts]
    steps = np.diff(log.time)[~is_start[1:]]
    max_duration = 2.0 * max(length_s, np.median(steps)) if len(steps) else 0.0
    keep = (flight[starts] == flight[ends]) & (durations <= max_duration)
    return Windows(starts[keep], ends[keep], durations[keep])


def agreement(log: FlightLog, change: np.ndarray, rate: np.ndarray) -> tuple[float, float]:
    """Return how well the change of one quantity and the integral of its rate agree.

    Uses the window length at which both correlate most. Where they are highly correlated, noise in
    either biases the slope little.

    Args:
        log: the log that holds the rows.
        change: a quantity, (num_rows, 3).
        rate: signal that should be its derivative, (num_rows, 3).

    Returns:
        correlation: of the changes and the integrals over windows; NaN without enough motion.
        slope: norm of the integrals over that of the changes; NaN without enough motion.
    """
    best, slope = np.nan, np.nan
    for length_s in WINDOWS_S:
        windows = cut_windows(log, length_s)
        if len(windows.starts) < MIN_WINDOWS:
            continue
        changes = windows.change_of(change) / windows.durations[:, None]
        means = windows.mean_of(log, rate)
        change_norm, mean_norm = np.linalg.norm(changes), np.linalg.norm(means)
        if min(change_norm, mean_norm) < STILL:
            continue
        correlation = np.sum(changes * means) / (change_norm * mean_norm)
        if not correlation < best:  # also true while ``best`` is NaN
            best, slope = float(correlation), float(mean_norm / change_norm)
    return best, slope


def estimate_slope(log: FlightLog, change: np.ndarray, rate: np.ndarray) -> float:
    """Return the ratio of a rate's integral to a change; NaN below ``MIN_CORRELATION``."""
    correlation, slope = agreement(log, change, rate)
    return slope if correlation >= MIN_CORRELATION else np.nan


def _is_about(value: float, factor: float) -> bool:
    """Return whether a value is within the tolerance of a known factor; False for NaN."""
    return abs(value / factor - 1.0) <= TOLERANCE


def _columns(*channels: str) -> str:
    return ", ".join(column for channel in channels for column in CHANNELS[channel])


def _with_time_in_s(log: FlightLog) -> tuple[FlightLog, list[str]]:
    """Return the log with its time in s, and the problem if it was in another unit."""
    steps = np.diff(log.time)[~log.is_start()[1:]]
    step = np.median(steps) if len(steps) else 0.0
    if step < MAX_STEP_S:
        return log, []
    likely = (unit for unit, per_second in PER_S.items() if step < MAX_STEP_S * per_second)
    unit = next(likely, "ns")
    problem = f"t: found a median step of {step:.4g}, expected less than {MAX_STEP_S:g} s"
    return replace(log, time=log.time / PER_S[unit]), [f"{problem}: this looks like {unit}"]


def _length(log: FlightLog) -> Iterator[str]:
    duration = np.diff(log.time)[~log.is_start()[1:]].sum()
    if len(log) < MIN_ROWS or duration < MIN_S:
        expected = f"expected at least {MIN_ROWS} rows and {MIN_S:g} s"
        yield (
            f"t: found {len(log)} rows and {duration:.3g} s, {expected}: too short to tell "
            "anything from"
        )


def _commands(log: FlightLog) -> Iterator[str]:
    if np.ptp(log["u"], axis=0).max() <= STILL:
        values = ", ".join(f"{value:g}" for value in log["u"][0])
        yield (
            f"{_columns('u')}: found {values} in every row, expected commands that move: they look "
            "stuck"
        )


def _motion(log: FlightLog) -> Iterator[str]:
    measured = [name for name in ("p", "v", "a", "f", "q", "w") if name in log]
    moving = {name for name in ("u", *measured) if np.ptp(log[name], axis=0).max() > STILL}
    if measured and moving == {"u"}:
        problem = "found the same values in every row while the commands move"
        yield f"{_columns(*measured)}: {problem}: the sensors or their logging look stuck"


def summed_turns(attitude: Rotation) -> np.ndarray:
    """Return the sum of the rotations between rows about the body's axes, (num_rows, 3) rad."""
    turns_b = (attitude[:-1].inv() * attitude[1:]).as_rotvec()
    return np.concatenate([np.zeros((1, 3)), np.cumsum(turns_b, axis=0)])


def _attitude(log: FlightLog) -> Iterator[str]:
    """Find an attitude that does not change although the body rates do not vanish."""
    if "q" not in log or "w" not in log:
        return
    windows = cut_windows(log, WINDOWS_S[-1])
    turn = np.linalg.norm(windows.mean_of(log, log["w"]), axis=1) * windows.durations
    if np.ptp(log["q"], axis=0).max() <= STILL and len(turn) and turn.max() > MIN_TURN:
        problem = (
            f"found the same in every row while {_columns('w')} turn by {turn.max():.2g} rad in a "
            "second"
        )
        yield f"{_columns('q')}: {problem}: the attitude looks stuck"


def _pairs(log: FlightLog) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return pairs of channels that measure the same motion, as a quantity and its rate."""
    pairs = {}
    if "q" in log:
        attitude = Rotation.from_quat(log["q"], scalar_first=True)
        if "w" in log:
            pairs["q and w"] = summed_turns(attitude), log["w"]
        if "f" in log and "v" in log:
            pairs["v and f by q"] = (
                log["v"],
                attitude.apply(log["f"]) - np.array([0.0, 0.0, GRAVITY]),
            )
    if "p" in log and "v" in log:
        pairs["p and v"] = log["p"], log["v"]
    return pairs


def _changed(
    channel: str, change: Callable[[np.ndarray], np.ndarray]
) -> Callable[[FlightLog], FlightLog]:
    return lambda log: replace(log, channels={**log.channels, channel: change(log[channel])})


def _rolled(quat: np.ndarray, signs: np.ndarray, step: int) -> np.ndarray:
    """Return quaternions with rolled components, (num_rows, 4).

    Args:
        quat: (num_rows, 4).
        signs: factors of 1 or -1, (4,), applied before and after.
        step: number of places to roll by.
    """
    return np.roll(quat * signs, step, axis=1) * signs


def _as_quaternions(change: Callable[[Rotation], Rotation]) -> Callable[[np.ndarray], np.ndarray]:
    return lambda quat: change(Rotation.from_quat(quat, scalar_first=True)).as_quat(
        scalar_first=True
    )


HALF_TURN = Rotation.from_rotvec([np.pi, 0.0, 0.0])  # about x: between FLU and FRD, z up and NED
TURN_SIGNS = np.array([1.0, -1.0, -1.0])
# Mistakes in a mapping: channel, text of the problem, and a function that corrects the log. A wrong
# quaternion order precedes the conversion of frames, which may have turned both body and world.
CONVENTIONS: tuple[tuple[str, str, Callable[[FlightLog], FlightLog]], ...] = (
    (
        "q",
        "is inverted: this looks like world to body, not body to world",
        _changed("q", _as_quaternions(Rotation.inv)),
    ),
    *(
        (
            "q",
            f"is read as {order}: this looks like the other order of the quaternion",
            _changed("q", partial(_rolled, signs=signs, step=step)),
        )
        for order, step in (("xyzw", 1), ("wxyz", -1))
        for signs in (np.ones(4), np.array([1.0, 1.0, -1.0, -1.0]))
    ),
    (
        "q",
        "has its body axes turned: this looks like the other of flu and frd",
        _changed("q", _as_quaternions(lambda attitude: attitude * HALF_TURN)),
    ),
    (
        "q",
        "has its world turned: this looks like the other of z_up and ned",
        _changed("q", _as_quaternions(lambda attitude: HALF_TURN * attitude)),
    ),
    (
        "q",
        "has body axes and world turned: this looks like the other of flu and frd, and of z_up and "
        "ned",
        _changed("q", _as_quaternions(lambda attitude: HALF_TURN * attitude * HALF_TURN)),
    ),
    *(
        (
            channel,
            f"has y and z turned: this looks like the other of {frames}",
            _changed(channel, TURN_SIGNS.__mul__),
        )
        for channel, frames in (
            ("w", "flu and frd"),
            ("f", "flu and frd"),
            ("v", "z_up and ned"),
            ("p", "z_up and ned"),
        )
    ),
)


def _conventions(log: FlightLog) -> Iterator[str]:
    """Compare channels that measure the same motion, and find the reading by which they agree."""
    if not _pairs(log) or ("f" in log and any(_force_sign(log))):
        return
    before = {name: agreement(log, *pair)[0] for name, pair in _pairs(log).items()}
    if not any(correlation < CONTRADICTION for correlation in before.values()):
        return
    resolved: dict[str, list[str]] = {}
    for channel, text, read_right in CONVENTIONS:
        if channel not in log:
            continue
        after = {name: agreement(log, *pair)[0] for name, pair in _pairs(read_right(log)).items()}
        resolved_pairs = [
            name
            for name in before
            if before[name] < CONTRADICTION and after[name] >= MIN_CORRELATION
        ]
        is_harmed = any(
            after[name] < min(before[name], MIN_CORRELATION)
            for name in before
            if name not in resolved_pairs
        )
        if resolved_pairs and not is_harmed:
            resolved.setdefault(", ".join(resolved_pairs), []).append(f"{channel} {text}")
    # Readings that resolve the most pairs explain the log best.
    max_pairs = max((len(names.split(", ")) for names in resolved), default=0)
    for names, readings in resolved.items():
        if len(names.split(", ")) == max_pairs:
            channel = readings[0].partition(" ")[0]
            pairs = ", ".join(
                f"{name} correlate by {before[name]:.2f}" for name in names.split(", ")
            )
            advice = "; or if ".join(dict.fromkeys(readings))
            yield (
                f"{_columns(channel)}: found motion that contradicts itself ({pairs}); it agrees "
                f"if {advice}"
            )
            return


def _rates(log: FlightLog) -> Iterator[str]:
    if "w" not in log:
        return
    if "q" in log:
        slope = estimate_slope(
            log, summed_turns(Rotation.from_quat(log["q"], scalar_first=True)), log["w"]
        )
        if _is_about(slope, np.rad2deg(1.0)):
            problem = f"found {slope:.3g} for the rates over those by {_columns('q')}, expected 1"
            yield f"{_columns('w')}: {problem}: this looks like deg/s, not rad/s"
            return
    fast = np.percentile(np.linalg.norm(log["w"], axis=1), FAST_PERCENTILE)
    if fast > FASTEST_RATE:
        problem = f"found a {FAST_PERCENTILE:g}th percentile of {fast:.0f}"
        expected = f"expected at most {FASTEST_RATE:.0f} rad/s, all that gyroscopes measure"
        yield f"{_columns('w')}: {problem}, {expected}: this looks like deg/s"


def _acceleration(log: FlightLog) -> Iterator[str]:
    """Compare the mean of ``a_z`` with the growth of ``v_z``."""
    if "a" not in log or "v" not in log:
        return
    windows = cut_windows(log, WINDOWS_S[-1])
    if len(windows.starts) == 0:
        return
    changes = windows.change_of(log["v"]) / windows.durations[:, None]
    offset = float(np.median((windows.mean_of(log, log["a"]) - changes)[:, 2]))
    if abs(offset - GRAVITY) <= MAX_BIAS:
        problem = f"found {offset:.3g} m/s^2 more than v_z changes by, expected 0 in hover"
        yield f"a_z: {problem}: gravity looks left in, as an accelerometer measures it"


def _force(log: FlightLog) -> Iterator[str]:
    if "f" in log:
        unit = list(_force_unit(log))
        yield from unit or _force_sign(log)


def _force_unit(log: FlightLog) -> Iterator[str]:
    """Compare the specific force with that from the velocity, or with the weight."""
    windows = cut_windows(log, WINDOWS_S[0])
    if len(windows.starts) < MIN_WINDOWS:
        return
    median_size = float(np.median(np.linalg.norm(windows.mean_of(log, log["f"]), axis=1)))
    if median_size > MAX_FORCE_G:
        return
    problem = f"{_columns('f')}: found a median size of {median_size:.3g}"
    if "v" in log:
        force_w = windows.change_of(log["v"]) / windows.durations[:, None] + np.array(
            [0.0, 0.0, GRAVITY]
        )
        expected = float(np.median(np.linalg.norm(force_w, axis=1)))
        if _is_about(median_size * GRAVITY, expected):
            yield f"{problem}, expected {expected:.3g} m/s^2 by {_columns('v')}: this looks like g"
        return
    starts = np.flatnonzero(log.is_start())
    longest_s = np.max(log.time[np.append(starts[1:], len(log)) - 1] - log.time[starts])
    if median_size >= 1.0 - TOLERANCE and longest_s >= LONG_FALL_S:
        yield f"{problem}, expected about {GRAVITY:.3g} m/s^2 to stay in the air: this looks like g"


def _force_sign(log: FlightLog) -> Iterator[str]:
    force_z = log["f"][:, 2]
    if "q" in log:
        body_z_w = Rotation.from_quat(log["q"], scalar_first=True).apply([0.0, 0.0, 1.0])
        force_z = force_z[body_z_w[:, 2] >= UPRIGHT]
    if len(force_z) >= MIN_UPRIGHT_ROWS and np.median(force_z) <= -MIN_FORCE_DOWN:
        problem = f"found a median of {np.median(force_z):.3g} m/s^2 where upright"
        yield f"f_z: {problem}, expected about {GRAVITY:.3g}: z looks as if it pointed down"


def _battery(log: FlightLog) -> Iterator[str]:
    median_v = float(np.median(log["v_bat"])) if "v_bat" in log else 0.0
    if median_v > HIGHEST_BATTERY_V:
        low, high = LIKELY_BATTERY_V
        units = [unit for factor, unit in BATTERY_UNITS.items() if low <= median_v / factor <= high]
        guess = f"this looks like {' or '.join(units)}" if units else "no battery has that"
        yield (
            f"v_bat: found a median of {median_v:.5g}, expected at most {HIGHEST_BATTERY_V:g} V: "
            f"{guess}"
        )


CHECKS: tuple[Callable[[FlightLog], Iterator[str]], ...]
CHECKS = (
    _length,
    _commands,
    _motion,
    _attitude,
    _conventions,
    _rates,
    _acceleration,
    _force,
    _battery,
)


def find_problems(log: FlightLog) -> list[str]:
    """Return the problems of a log that no flight can have, a sentence each; empty if none.

    Each sentence names the source, the columns, what was found, and why it looks wrong. If the time
    is not in s, the other checks use the corrected time.
    """
    log, problems = _with_time_in_s(log)
    problems = [*problems, *(problem for check in CHECKS for problem in check(log))]
    return [f"{log.source}: {problem}" for problem in problems]


def check_plausible(log: FlightLog) -> None:
    """Raise LogError for a log that no flight can have; the message has a line for each problem."""
    problems = find_problems(log)
    if problems:
        raise LogError("\n".join(problems))
