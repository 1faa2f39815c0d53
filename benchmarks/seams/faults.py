"""Faults of logs: wrong units, signs, frames, quaternion orders, clocks, commands and motors.

A fault draws a set of ``Change``; ``inject`` puts it into a flight; ``is_shown`` says from the true
motion whether the flight has the motion that shows it.

Kinds and values of changes; channels are those of a log, ``u_rates`` and ``u_thrust`` of its
commands, ``rows`` all, ``motors`` the motor outputs:

- ``scale``: logged = value * true.
- ``axes``: "y -x z" if the logged x, y, z are the true y, -x, z; "-" of the thrust command, and of
  the voltage, which then rises by as much as it falls.
- ``delay``: s; the value logged at t is the true one of t - delay.
- ``order`` of q: "xyzw" if columns w, x, y, z hold x, y, z, w; "zwxy" if they hold z, w, x, y.
  Of motors: "2 1 3 4" if the first column is motor 2.
- ``conjugate``: q is world to body.
- ``body``, ``world`` of q: axes of that frame, as ``axes``.
- ``wrapped``: yaw was interpolated across +-180 degrees.
- ``curve``: u_rates are stick positions; this curve of Betaflight gives the true rate command.
- ``range`` of u_thrust: "pwm" of 1000..2000, "0..1".
- ``held``: rows for which each sample is repeated.
- ``repeated``: fraction of rows that repeat the one before.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.seams.craft import GRAVITY, MOMENT_SIGNS
from benchmarks.seams.flight import Flight, multiply
from flytrack_sysid.log import FlightLog

Value = float | str | bool
Truth = frozenset["Change"]


class Change(NamedTuple):
    """A difference between a log and FlyTrack's conventions: channel, kind and value."""

    channel: str
    kind: str
    value: Value


DEG = 180.0 / np.pi
UNITS = {  # channel, and the logged number of one SI unit
    "w in deg/s": ("w", DEG),
    "w in counts": ("w", 16.4 * DEG),
    "f in g": ("f", 1.0 / GRAVITY),
    "f in mm/s^2": ("f", 1000.0),
    "p in mm": ("p", 1000.0),
    "p in ft": ("p", 1.0 / 0.3048),
    "v in cm/s": ("v", 100.0),
    "v in mm/s": ("v", 1000.0),
    "v in km/h": ("v", 3.6),
    "v_bat in mV": ("v_bat", 1000.0),
}
SIGNS = ("-x y z", "x -y z", "x y -z")
SWAPS = ("y x z", "z y x", "x z y")
FRD, NED = "x -y -z", "y x -z"  # of FLU or NWU; of ENU
ROOT = np.sqrt(0.5)
HALF_TURNS = {  # quaternions of rotations that are their own inverse
    FRD: (0.0, 1.0, 0.0, 0.0),
    "-x y -z": (0.0, 0.0, 1.0, 0.0),
    "-x -y z": (0.0, 0.0, 0.0, 1.0),
    NED: (0.0, ROOT, ROOT, 0.0),
}
Q_ORDERS = {"xyzw": [1, 2, 3, 0], "zwxy": [3, 0, 1, 2]}
FRAMES = {"w": (FRD,), "f": (FRD,), "v": (FRD, NED), "p": (FRD, NED), "u_rates": (FRD,)}
DELAYS_S = {"u": (0.02, 0.2), **dict.fromkeys("qvpfw", (0.005, 0.05))}
# Changes are made in this order: what was measured, frames, numbers, storage.
KINDS = (
    *("delay", "curve", "conjugate", "body", "world", "axes", "scale", "range"),
    *("wrapped", "held", "order", "repeated"),
)


def _choose(channel: str, kind: str, *values: Value) -> "Fault":
    return lambda rng, _: frozenset({Change(channel, kind, values[rng.integers(len(values))])})


def _delay(channel: str) -> "Fault":
    def draw(rng: np.random.Generator, dt: float) -> Truth:
        delay_s = rng.uniform(*DELAYS_S[channel])
        if channel == "u":  # it is held, so it is late by whole rows
            delay_s = max(1, round(delay_s / dt)) * dt
        return frozenset({Change(channel, "delay", delay_s)})

    return draw


def _repeated(rng: np.random.Generator, _: float) -> Truth:
    return frozenset({Change("rows", "repeated", rng.uniform(0.05, 0.2))})


def _whole_frd(*_: object) -> Truth:
    channels = [Change(channel, "axes", FRD) for channel in ("w", "f", "v", "p", "u_rates")]
    return frozenset({Change("q", "body", FRD), Change("q", "world", FRD), *channels})


MOTOR_SWAPS = ("2 1 3 4", "3 2 1 4", "4 2 3 1", "1 3 2 4", "1 4 3 2", "1 2 4 3")
Fault = Callable[[np.random.Generator, float], Truth]  # of the time between rows, s
FAULTS: dict[str, Fault] = {
    **{name: _choose(channel, "scale", scale) for name, (channel, scale) in UNITS.items()},
    **{f"{channel} sign": _choose(channel, "axes", *SIGNS) for channel in FRAMES},
    **{f"{channel} swapped": _choose(channel, "axes", *SWAPS) for channel in FRAMES},
    **{f"{channel} frame": _choose(channel, "axes", *frames) for channel, frames in FRAMES.items()},
    "q order": _choose("q", "order", *Q_ORDERS),
    "q conjugate": _choose("q", "conjugate", True),
    "q body": _choose("q", "body", FRD),
    "q world": _choose("q", "world", FRD, NED),
    "all NED and FRD": _whole_frd,
    "q wrapped": _choose("q", "wrapped", True),
    "u_rates curve": _choose("u_rates", "curve", "actual", "betaflight", "quick"),
    **{f"{channel} delay": _delay(channel) for channel in DELAYS_S},
    **{f"{channel} held": _choose(channel, "held", 3, 4, 5, 7, 10) for channel in "wqvpf"},
    "rows repeated": _repeated,
    "u_thrust pwm": _choose("u_thrust", "range", "pwm"),
    "u_thrust 0..1": _choose("u_thrust", "range", "0..1"),
    "u_thrust upside down": _choose("u_thrust", "axes", "-"),
    "v_bat rises": _choose("v_bat", "axes", "-"),
    "motors order": _choose("motors", "order", *MOTOR_SWAPS),
}
PAIRS_ON_A_CHANNEL = (
    ("w in deg/s", "w frame"),
    ("w in counts", "w sign"),
    ("w in deg/s", "w delay"),
    ("f in g", "f frame"),
    ("p in mm", "p frame"),
    ("v in cm/s", "v frame"),
    ("v in mm/s", "v delay"),
    ("q order", "q body"),
    ("q order", "q world"),
    ("q order", "q conjugate"),
    ("q order", "q delay"),
    ("u_rates frame", "u delay"),
    ("u_rates sign", "u_thrust 0..1"),
)


def draw_pair(rng: np.random.Generator, dt: float) -> tuple[str, Truth]:
    """Draw the names and the changes of two faults, half the time on the same channel."""
    if rng.random() < 0.5:
        first, second = PAIRS_ON_A_CHANNEL[rng.integers(len(PAIRS_ON_A_CHANNEL))]
        return f"{first}, {second}", FAULTS[first](rng, dt) | FAULTS[second](rng, dt)
    while True:
        names = rng.choice(list(FAULTS), 2, replace=False)
        first_truth, second_truth = (FAULTS[name](rng, dt) for name in names)
        channels = {change.channel[0] for change in first_truth}
        if channels.isdisjoint(change.channel[0] for change in second_truth):
            return ", ".join(names), first_truth | second_truth


# Injection


def inject(rng: np.random.Generator, flight: Flight, truth: Truth) -> Flight:
    """Return a flight with changes put into its log and motors; its truth stays."""
    for change in sorted(truth, key=lambda change: KINDS.index(change.kind)):
        flight = _inject_one(rng, flight, change)
    return flight


def _inject_one(rng: np.random.Generator, flight: Flight, change: Change) -> Flight:
    """Return a flight with one change."""
    log, (channel, kind, value) = flight.log, change
    if channel == "rows":
        rows = np.arange(len(log)) - (rng.random(len(log)) < float(value))
        rows[0] = 0
        log = replace(log.select(rows), time=log.time, segment=log.segment)
        return flight._replace(log=log, motors=flight.motors[rows])
    if channel == "motors":
        order = [int(number) - 1 for number in str(value).split()]
        return flight._replace(motors=flight.motors[:, order])
    name = channel.removesuffix("_rates").removesuffix("_thrust")
    values, columns = log[name].copy(), slice(None)
    if name == "u" and channel != "u":
        columns = slice(3) if channel == "u_rates" else slice(3, 4)
    if kind == "delay":
        changed = _late(flight.truth, log, channel, float(value))
    elif kind == "held":
        rows = np.arange(len(log))
        changed = values[rows - rows % int(value)]
    elif channel == "v_bat" and kind == "axes":
        changed = values.max() + values.min() - values
    elif kind == "wrapped":
        changed = _interpolate_across_wrap(log, source_rows=int(rng.integers(4, 7)))
    else:
        changed = CHANGES[kind](values[:, columns], value)
    values[:, columns] = changed
    return flight._replace(log=replace(log, channels={**log.channels, name: values}))


def axes_matrix(text: str) -> np.ndarray:
    """Return the matrix that turns true axes into those written as "y -x z"."""
    signs = [-1.0 if "-" in axis else 1.0 for axis in text.split()]
    return np.diag(signs) @ np.eye(3)[["xyz".index(axis[-1]) for axis in text.split()]]


def _change_axes(values: np.ndarray, text: str) -> np.ndarray:
    """Return columns permuted, with signs; text: "-" for one column."""
    return -values if text == "-" else values @ axes_matrix(text).T


def _stick(rates: np.ndarray, curve: str) -> np.ndarray:
    """Return the stick positions that give rate commands, by Betaflight's ``rc_rates`` formulas."""
    stick = np.linspace(0.0, 1.0, 1001)
    command = {
        # Center sensitivity 0.2 of the full rate, expo 0.5.
        "actual": 0.2 * stick + 0.8 * stick * (0.5 * stick**5 + 0.5 * stick),
        # Expo 0.2, super rate 0.7.
        "betaflight": 0.3 * (0.2 * stick**4 + 0.8 * stick) / (1.0 - 0.7 * stick),
        # Full rate over center rate 3, expo 0.3.
        "quick": stick / 3.0 / (1.0 - 2.0 / 3.0 * (0.3 * stick**3 + 0.7 * stick)),
    }[curve]
    return np.sign(rates) * np.interp(np.abs(rates), command, stick)


def _in_range(thrust: np.ndarray, name: str) -> np.ndarray:
    """Return thrust commands of -1..1 in another range."""
    return 1500.0 + 500.0 * thrust if name == "pwm" else 0.5 * (thrust + 1.0)


CHANGES: dict[str, Callable[..., np.ndarray]] = {
    "scale": lambda values, scale: values * scale,
    "axes": _change_axes,
    "order": lambda q, order: q[:, Q_ORDERS[order]],
    "conjugate": lambda q, _: q * [1.0, -1.0, -1.0, -1.0],
    "body": lambda q, frame: multiply(q, np.array(HALF_TURNS[frame])),
    "world": lambda q, frame: multiply(np.array(HALF_TURNS[frame]), q),
    "curve": _stick,
    "range": _in_range,
}


def _late(truth: FlightLog, log: FlightLog, channel: str, delay_s: float) -> np.ndarray:
    """Return a channel with the truth of ``delay_s`` before, and the noise that it has."""
    times, true = log.time, truth[channel]
    if channel == "u":
        rows = np.arange(len(log)) - round(delay_s / (times[1] - times[0]))
        return log["u"][np.maximum(rows, 0)]
    late = np.stack([np.interp(times - delay_s, times, column) for column in true.T], axis=1)
    if channel != "q":
        return late + log[channel] - true
    late /= np.linalg.norm(late, axis=1, keepdims=True)
    noise = multiply(true * [1.0, -1.0, -1.0, -1.0], log["q"])
    return multiply(late, noise)


def _yaw(log: FlightLog) -> np.ndarray:
    """Return the heading of each row, rad in (-pi, pi]."""
    nose = Rotation.from_quat(log["q"], scalar_first=True).apply([1.0, 0.0, 0.0])
    return np.arctan2(nose[:, 1], nose[:, 0])


def _interpolate_across_wrap(log: FlightLog, source_rows: int) -> np.ndarray:
    """Return attitudes whose yaw, in (-180, 180] degrees, was interpolated between every few rows.

    Only what lies between two source rows on both sides of the wrap is changed.
    """
    yaw = _yaw(log)
    rows = np.arange(len(yaw))
    sources = rows[::source_rows]
    jumps = np.abs(np.diff(yaw[sources], append=yaw[sources[-1]])) > np.pi
    is_changed = jumps[rows // source_rows] & (rows % source_rows > 0)
    turn = np.where(is_changed, np.interp(rows, sources, yaw[sources]) - yaw, 0.0)
    turns = Rotation.from_euler("z", turn[:, None]).as_quat(scalar_first=True)
    return multiply(turns, log["q"])


# Motion


def is_shown(flight: Flight, truth: Truth) -> bool:
    """Return whether the true motion of a flight shows each of some changes."""
    motion = _motion(flight.truth)
    return all(_is_one_shown(motion, change) for change in truth)


class _Motion(NamedTuple):
    """Of a flight without noise.

    Attributes:
        rates: rms about body x, y, z, rad/s.
        turns: rms angular acceleration about body x, y, z, rad/s^2.
        drag: rms specific force along body x, y, m/s^2.
        speeds: rms along world x, y, z, m/s.
        accelerations: rms along world x, y, z, m/s^2.
        tilt: rms, rad.
        lift_spread: standard deviation of the specific force along body z, m/s^2.
        stick: share of the time with a rate command above 0.3 of full rate.
        wraps: times that yaw crosses 180 degrees.
    """

    rates: np.ndarray
    turns: np.ndarray
    drag: np.ndarray
    speeds: np.ndarray
    accelerations: np.ndarray
    tilt: float
    lift_spread: float
    stick: float
    wraps: int


def _motion(truth: FlightLog) -> _Motion:
    def rms(values: np.ndarray) -> np.ndarray:
        return np.sqrt(np.mean(values**2, axis=0))

    _, x, y, _ = truth["q"].T
    return _Motion(
        rates=rms(truth["w"]),
        turns=rms(np.gradient(truth["w"], truth.time, axis=0)),
        drag=rms(truth["f"][:, :2]),
        speeds=rms(truth["v"]),
        accelerations=rms(np.gradient(truth["v"], truth.time, axis=0)),
        tilt=float(rms(2.0 * np.arcsin(np.minimum(np.hypot(x, y), 1.0)))),
        lift_spread=float(np.std(truth["f"][:, 2])),
        stick=float(np.mean(np.abs(truth["u"][:, :3]).max(axis=1) > 0.3)),
        wraps=int(np.sum(np.abs(np.diff(_yaw(truth))) > np.pi)),
    )


def _is_one_shown(motion: _Motion, change: Change) -> bool:
    """Return whether a flight shows a change.

    Thresholds are some times what the noise of ``flight.make_flight`` leaves over a second or so:
    0.05 rad/s of gyro, 0.5 degrees of attitude, 0.1 m/s^2 of accelerometer bias, 0.05 m/s.
    """
    channel, kind, value = change
    if channel == "v_bat":
        return True
    turning = bool(np.all(motion.rates[:2] > 0.2) and motion.tilt > 0.1)
    if kind == "axes" and value != "-":
        changed = np.diag(axes_matrix(str(value))) != 1.0
        strength, least = {
            "w": (motion.rates, 0.15),  # rad/s
            "u_rates": (motion.rates, 0.15),
            "f": (np.append(motion.drag, GRAVITY), 0.3),  # m/s^2
            "v": (np.minimum(motion.speeds, motion.accelerations), 0.3),  # m/s, m/s^2
            "p": (motion.speeds, 0.3),
        }[channel]
        return bool(np.all(strength[changed] > least))
    if kind == "delay":
        if channel in ("v", "p", "f"):  # late by 5 ms, velocity is false by 5 mm/s at 1 m/s^2
            return bool(np.linalg.norm(motion.accelerations) > 1.0)
        return bool(np.linalg.norm(motion.turns) > 2.0)  # late by 5 ms, rates are by 0.01 rad/s
    if kind == "scale":
        rms = {"w": motion.rates, "v": motion.speeds, "p": motion.speeds}.get(channel)
        return rms is None or bool(np.linalg.norm(rms) > 0.2)
    if channel == "motors":
        first, second = (i for i in range(4) if int(str(value).split()[i]) != i + 1)
        moved = MOMENT_SIGNS[:, first] != MOMENT_SIGNS[:, second]
        return bool(np.all(motion.turns[moved] > np.array([3.0, 3.0, 1.0])[moved]))
    return {
        "order": turning,
        "conjugate": turning,
        "body": turning,
        "world": turning and bool(np.all(motion.accelerations[:2] > 0.5)),
        "wrapped": motion.wraps >= 2,
        "curve": motion.stick > 0.02,
        "range": value == "pwm" or motion.lift_spread > 1.0,
        "axes": motion.lift_spread > 0.5,  # of thrust
    }.get(kind, True)
