"""Does a log that can be read describe a flight? Units, gravity and signs, stuck columns, too little data.

What one channel says of the motion is compared with what another says, over windows of 0.1 to 1 s so that
noise averages out. A unit is named wrong only where both move alike, by about a known factor; where the
motion is too small to tell, nothing is said. Of frames, only the direction of ``q`` and the z of ``f`` are
compared.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import nominal_parameters
from flytrack_sysid.log import CHANNELS, FlightLog, LogError
from flytrack_sysid.windows import FEWEST_WINDOWS, STILL, WINDOWS_S, slope_of, windows_of

GRAVITY = float(nominal_parameters().g)  # m/s^2
TOLERANCE = 0.15  # of a known wrong factor: scale errors of sensors stay well below it
FEWEST_ROWS = 100
FEWEST_UPRIGHT_ROWS = 20
SHORTEST_S = 2.0
LONGEST_STEP_S = 0.5  # no log of a drone is as slow as 2 Hz
PER_S = {"ms": 1e3, "us": 1e6, "ns": 1e9}
LEAST_TURN = 0.3  # rad within a second: more than a gyroscope's bias makes of a drone that stands still
FAST_PERCENTILE = 99.0  # of the rates: a lone spike is no unit
FASTEST_RATE = float(np.deg2rad(4000.0))  # rad/s, the widest range among common gyroscopes
HIGHEST_BATTERY_V = 100.0  # drones' batteries end at about 60 V
LIKELY_BATTERY_V = (2.5, 70.0)  # an empty cell; more than a full pack of 14 in row
LARGEST_FORCE_G = 3.0  # median specific force of a flight, in g; racing is below it
LARGEST_BIAS = 2.5  # m/s^2, of an accelerometer in flight, vibration included
LONG_FALL_S = 5.0  # a drone whose force is that small for so long fell out of the sky
LEAST_FORCE_DOWN = 0.5 * GRAVITY  # m/s^2 along -z of the body; drag in a fast climb is less
UPRIGHT = float(np.cos(np.deg2rad(45.0)))  # cosine of the tilt

RATE_UNITS = {float(np.rad2deg(1.0)): ("w", "deg/s", "rad/s")}
PLACE_UNITS = {
    1000.0: ("p", "mm", "m"),
    100.0: ("p", "cm", "m"),
    0.01: ("v", "cm/s", "m/s"),
    0.001: ("v", "mm/s", "m/s"),
}
ACCELERATION_UNITS = {1.0 / GRAVITY: ("a", "g", "m/s^2")}
BATTERY_UNITS = {1000.0: "mV", 100.0: "hundredths of V", 10.0: "tenths of V"}


def is_about(value: float, factor: float) -> bool:
    """Return whether a value is within the tolerance of a known factor; nan is not."""
    return abs(value / factor - 1.0) <= TOLERANCE


def _columns(*channels: str) -> str:
    return ", ".join(column for channel in channels for column in CHANNELS[channel])


def _wrong_unit(slope: float, units: Mapping[float, tuple[str, str, str]], ratio: str) -> list[str]:
    """Return the problem of a slope that a wrong unit explains; ratio: what the slope is of."""
    for factor, (channel, unit, expected) in units.items():
        if is_about(slope, factor):
            found = f"found {slope:.3g} for {ratio}, expected 1"
            return [f"{_columns(channel)}: {found}: this looks like {unit}, not {expected}"]
    return []


def _time(log: FlightLog) -> tuple[FlightLog, list[str]]:
    """Return the log with its time in s, and the problem if it was not: other checks need it."""
    steps = np.diff(log.time)[~log.is_start()[1:]]
    step = np.median(steps) if len(steps) else 0.0
    if step < LONGEST_STEP_S:
        return log, []
    likely = (unit for unit, per_second in PER_S.items() if step < LONGEST_STEP_S * per_second)
    unit = next(likely, "ns")
    per_second = PER_S[unit]
    problem = f"t: found a median step of {step:.4g}, expected less than {LONGEST_STEP_S:g} s"
    return replace(log, time=log.time / per_second), [f"{problem}: this looks like {unit}"]


def _length(log: FlightLog) -> list[str]:
    duration = np.diff(log.time)[~log.is_start()[1:]].sum()
    if len(log) >= FEWEST_ROWS and duration >= SHORTEST_S:
        return []
    expected = f"expected at least {FEWEST_ROWS} rows and {SHORTEST_S:g} s"
    return [f"t: found {len(log)} rows and {duration:.3g} s, {expected}: too short to tell anything from"]


def _commands(log: FlightLog) -> list[str]:
    if np.ptp(log["u"], axis=0).max() > STILL:
        return []
    found = ", ".join(f"{value:g}" for value in log["u"][0])
    return [f"{_columns('u')}: found {found} in every row, expected commands that move: they look stuck"]


def _motion(log: FlightLog) -> list[str]:
    measured = [name for name in ("p", "v", "a", "f", "q", "w") if name in log]
    is_moving = any(np.ptp(log[name], axis=0).max() > STILL for name in measured)
    if not measured or is_moving or _commands(log):
        return []
    found = "found the same values in every row while the commands move"
    return [f"{_columns(*measured)}: {found}: the sensors, or whoever logged them, look stuck"]


def _turned(attitude: Rotation) -> np.ndarray:
    """Return the sum of the turns between rows about the body's axes, (num_rows, 3) rad."""
    turns_b = (attitude[:-1].inv() * attitude[1:]).as_rotvec()
    return np.concatenate([np.zeros((1, 3)), np.cumsum(turns_b, axis=0)])


def _attitude(log: FlightLog) -> list[str]:
    """Compare the attitude with the rates: does it move with them, and in the right direction?"""
    if "q" not in log or "w" not in log:
        return []
    windows = windows_of(log, WINDOWS_S[-1])
    turn = np.linalg.norm(windows.mean_of(log, log["w"]), axis=1) * windows.durations
    if np.ptp(log["q"], axis=0).max() <= STILL:
        if not len(turn) or turn.max() <= LEAST_TURN:
            return []
        found = f"found the same in every row while {_columns('w')} turn by {turn.max():.2g} rad in a second"
        return [f"{_columns('q')}: {found}: the attitude looks stuck"]
    attitude = Rotation.from_quat(log["q"], scalar_first=True)
    slopes = [slope_of(log, _turned(one), log["w"]) for one in (attitude, attitude.inv())]
    if not np.isnan(slopes[0]) or not is_about(slopes[1], 1.0):
        return []
    found = f"found turns that agree with {_columns('w')} only if it is inverted"
    return [f"{_columns('q')}: {found}: this looks like world to body, not body to world"]


def _rates(log: FlightLog) -> list[str]:
    if "w" not in log:
        return []
    problems = []
    if "q" in log:
        slope = slope_of(log, _turned(Rotation.from_quat(log["q"], scalar_first=True)), log["w"])
        problems = _wrong_unit(slope, RATE_UNITS, f"the rates over those by {_columns('q')}")
    fast = np.percentile(np.linalg.norm(log["w"], axis=1), FAST_PERCENTILE)
    if problems or fast <= FASTEST_RATE:
        return problems
    found = (
        f"found a {FAST_PERCENTILE:g}th percentile of {fast:.0f}, expected at most {FASTEST_RATE:.0f} rad/s"
    )
    return [f"{_columns('w')}: {found}, all that gyroscopes measure: this looks like deg/s"]


def _position(log: FlightLog) -> list[str]:
    if "p" not in log or "v" not in log:
        return []
    slope = 1.0 / slope_of(log, log["p"], log["v"])
    return _wrong_unit(slope, PLACE_UNITS, f"the way by {_columns('p')} over that by {_columns('v')}")


def _acceleration(log: FlightLog) -> list[str]:
    """Compare increments less their mean, which a bias or gravity is in; then that mean."""
    if "a" not in log or "v" not in log:
        return []
    slope = slope_of(log, log["v"], log["a"], is_centred=True)
    problems = _wrong_unit(slope, ACCELERATION_UNITS, f"the accelerations over those by {_columns('v')}")
    windows = windows_of(log, WINDOWS_S[-1])
    if problems or len(windows.starts) == 0:
        return problems
    changes = windows.change_of(log["v"]) / windows.durations[:, None]
    offset = float(np.median((windows.mean_of(log, log["a"]) - changes)[:, 2]))
    if abs(offset - GRAVITY) > LARGEST_BIAS or not (np.isnan(slope) or is_about(slope, 1.0)):
        return []
    text = f"found {offset:.3g} m/s^2 more than v_z changes by, expected 0 in hover"
    return [f"a_z: {text}: gravity looks left in, as an accelerometer measures it"]


def _force(log: FlightLog) -> list[str]:
    if "f" not in log:
        return []
    return _force_unit(log) or _force_sign(log)


def _force_unit(log: FlightLog) -> list[str]:
    """Compare the size of the specific force with what the velocity says, or with what keeps a drone up."""
    windows = windows_of(log, WINDOWS_S[0])
    if len(windows.starts) < FEWEST_WINDOWS:
        return []
    found = float(np.median(np.linalg.norm(windows.mean_of(log, log["f"]), axis=1)))
    if found > LARGEST_FORCE_G:
        return []
    problem = f"{_columns('f')}: found a median size of {found:.3g}"
    if "v" in log:
        force_w = windows.change_of(log["v"]) / windows.durations[:, None] + np.array([0.0, 0.0, GRAVITY])
        expected = float(np.median(np.linalg.norm(force_w, axis=1)))
        if not is_about(found * GRAVITY, expected):
            return []
        return [f"{problem}, expected {expected:.3g} m/s^2 by {_columns('v')}: this looks like g"]
    starts = np.flatnonzero(log.is_start())
    longest = np.max(log.time[np.append(starts[1:], len(log)) - 1] - log.time[starts])
    if found < 1.0 - TOLERANCE or longest < LONG_FALL_S:
        return []
    return [f"{problem}, expected about {GRAVITY:.3g} m/s^2 to stay in the air: this looks like g"]


def _force_sign(log: FlightLog) -> list[str]:
    force_z = log["f"][:, 2]
    if "q" in log:
        body_z_w = Rotation.from_quat(log["q"], scalar_first=True).apply([0.0, 0.0, 1.0])
        force_z = force_z[body_z_w[:, 2] >= UPRIGHT]
    if len(force_z) < FEWEST_UPRIGHT_ROWS or np.median(force_z) > -LEAST_FORCE_DOWN:
        return []
    found = f"found a median of {np.median(force_z):.3g} m/s^2 where upright"
    return [f"f_z: {found}, expected about {GRAVITY:.3g}: z looks as if it pointed down"]


def _battery(log: FlightLog) -> list[str]:
    if "v_bat" not in log:
        return []
    found = float(np.median(log["v_bat"]))
    if found <= HIGHEST_BATTERY_V:
        return []
    low, high = LIKELY_BATTERY_V
    units = [unit for factor, unit in BATTERY_UNITS.items() if low <= found / factor <= high]
    guess = f"this looks like {' or '.join(units)}" if units else "no battery has that"
    return [f"v_bat: found a median of {found:.5g}, expected at most {HIGHEST_BATTERY_V:g} V: {guess}"]


CHECKS: tuple[Callable[[FlightLog], list[str]], ...] = (
    _length,
    _commands,
    _motion,
    _attitude,
    _rates,
    _position,
    _acceleration,
    _force,
    _battery,
)


def find_problems(log: FlightLog) -> list[str]:
    """Return what in a log cannot be true of a flight, a sentence each; empty if nothing.

    Each names the source, the columns, what was found, and why it looks wrong. Where time is not in s, the
    other checks see it corrected.
    """
    log, problems = _time(log)
    for check in CHECKS:
        problems = problems + check(log)
    return [f"{log.source}: {problem}" for problem in problems]


def check_plausible(log: FlightLog) -> None:
    """Do nothing for a log that may be of a flight.

    Raises:
        LogError: ``find_problems`` found some; the message has them all, a line each.
    """
    problems = find_problems(log)
    if problems:
        raise LogError("\n".join(problems))
