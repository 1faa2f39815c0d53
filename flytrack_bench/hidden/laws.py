"""Laws outside the package's list (drawn in ``outside.py``), and random processes."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from flytrack_bench.hidden.truth import GRAVITY, Outside, Truth
from flytrack_bench.hidden.vectors import (
    Number,
    Vector,
    acos,
    add,
    atan2,
    cos,
    exp,
    maximum,
    minimum,
    norm,
    scale,
    tanh,
    to_body,
)

# An amplitude of 1, the noise of common sensors: m/s^2 of forces and of thrust over mass, rad/s of
# rates.
SCALES = {"force": 1.5, "thrust": 1.5, "rate": 0.1}
HEADING_ORDERS = (2, 3)
REFERENCE_V = 23.0  # at which the slope of the thrust turns a force into a share of the stick
TINY_SPEED = 1e-6  # m/s, keeps 0 / 0 away
USUAL_SPEED_MS, DAMPING = 5.0, 0.4


class FirstOrderNoise:
    """Independent first-order random processes of standard deviation 1 with a time constant, s."""

    def __init__(self, time_constant_s: float, rng: np.random.Generator, count: int = 3):
        self._time_constant_s, self._rng = time_constant_s, rng
        self.now = tuple(rng.standard_normal(count).tolist())

    def step(self, step_s: float) -> tuple[float, ...]:
        """Return the next values, a step later."""
        keep = math.exp(-step_s / self._time_constant_s)
        size = math.sqrt(1.0 - keep * keep)
        fresh = self._rng.standard_normal(len(self.now)).tolist()
        self.now = tuple(keep * old + size * new for old, new in zip(self.now, fresh, strict=True))
        return self.now


def _bump(value: Number, middle: float, width: float) -> Number:
    return exp(-0.5 * ((value - middle) / width) ** 2)


def _position(shape: Any, drone: Any) -> Number:
    away = add(drone.pos_w, scale(-1.0, drone.centre_w))
    return _bump(norm(away), 0.0, shape["radius_m"])


def _time(shape: Any, drone: Any) -> Number:
    share, middle, width = (
        drone.time_s / drone.duration_s,
        shape["middle_share"],
        shape["width_share"],
    )
    is_step = shape["is_step"]
    return 0.5 + 0.5 * tanh((share - middle) / width) if is_step else _bump(share, middle, width)


def _heading(drone: Any) -> Number:
    return atan2(drone.rows[1][0], drone.rows[0][0])


def heading_waves(shape: Any, heading: Any) -> Any:
    """Return the sum of waves of orders 2 and 3 in the heading, rad: a number or an array."""
    cosine = np.cos if isinstance(heading, np.ndarray) else cos
    return sum(
        shape[f"size_{n}"] * cosine(n * heading + shape[f"phase_{n}"]) for n in HEADING_ORDERS
    )


def _attitude(shape: Any, drone: Any) -> Number:
    tilt_deg = math.degrees(1.0) * acos(maximum(minimum(drone.rows[2][2], 1.0), -1.0))
    return _bump(tilt_deg, shape["tilt_deg"], shape["width_deg"])


def _heating(shape: Any, drone: Any) -> float:
    """Return half of a temperature that follows the squared thrust; the drone stores it."""
    now = drone.time_s
    last, warmth = getattr(drone, "heat", (now, 0.0))
    warmth += -math.expm1(-(now - last) / shape["warming_s"]) * (
        (drone.thrust_acc / GRAVITY) ** 2 - warmth
    )
    drone.heat = now, warmth
    return 0.5 * warmth


def _payload(shape: Any, drone: Any) -> Vector:
    """Return a hanging payload's horizontal offset, world, over the length of its string."""
    now = drone.time_s
    last, off, speed = getattr(drone, "swing", (now, (0.0,) * 3, (0.0,) * 3))
    step_s, stiffness = now - last, GRAVITY / shape["string_m"]
    pull = tuple(
        -acc - stiffness * x - DAMPING * v
        for acc, x, v in zip(drone.acc_w, off, speed, strict=True)
    )
    speed = tuple(v + step_s * a for v, a in zip(speed, pull, strict=True))
    off = tuple(x + step_s * v for x, v in zip(off, speed, strict=True))
    drone.swing = now, off, speed
    return scale(1.0 / shape["string_m"], (off[0], off[1], 0.0))


# Kind -> its signal, of the parameters and the drone; other kinds have hooks of their own.
SIGNALS: dict[str, Callable[[Any, Any], Number]] = {
    "position": _position,
    "time": _time,
    "heading": lambda shape, drone: heading_waves(shape, _heading(drone)) / shape["largest"],
    "airspeed": lambda shape, drone: _bump(
        norm(drone.airspeed_b), shape["speed_ms"], shape["width_ms"]
    ),
    "attitude": _attitude,
    "periodic": lambda shape, drone: math.sin(
        2.0 * math.pi * shape["frequency_hz"] * drone.time_s + shape["phase"]
    ),
    "flapping": lambda shape, drone: drone.airspeed_b[0] / USUAL_SPEED_MS,
    "cable": lambda shape, drone: cos(_heading(drone) + shape["phase"]),
    "heating": _heating,
}
# Those that neither remember nor depend on the time: JAX flies them, too.
STATELESS_KINDS = ("airspeed", "attitude", "heading", "flapping", "cable", "position")


def noise_hook(process: FirstOrderNoise, size: float, channel: str) -> Callable[[Any], Vector]:
    """Return a hook that adds what a process has now: as a force of the world, or as body rates."""
    if channel == "rate":
        return lambda drone: scale(size, process.now)
    return lambda drone: to_body(drone.rows, scale(size, process.now))


def vector_hook(outside: Outside) -> Callable[[Any], Vector]:
    """Return a hook that adds force, m/s^2, or rates, rad/s, body; not for "stochastic"."""
    size, shape = outside.amplitude * SCALES[outside.channel], outside.shape
    if outside.kind == "payload":
        return lambda drone: to_body(drone.rows, scale(size, _payload(shape, drone)))
    signal = SIGNALS[outside.kind]
    if outside.kind == "airspeed":

        def against(drone: Any) -> Vector:
            speed = maximum(norm(drone.airspeed_b), TINY_SPEED)
            return scale(-size * signal(shape, drone) / speed, drone.airspeed_b)

        return against
    way = (shape["x"], shape["y"], shape["z"])
    if outside.kind in ("position", "cable"):
        return lambda drone: to_body(drone.rows, scale(size * signal(shape, drone), way))
    return lambda drone: scale(size * signal(shape, drone), way)


def command_hook(outside: Outside, truth: Truth) -> Callable[[Any, Vector], Vector]:
    """Return a hook on commands: a dead zone or backlash of one stick."""
    axis = int(outside.shape["axis"])
    size = outside.amplitude * SCALES[outside.channel]
    if outside.channel == "thrust":
        slope = (truth.thrust(1.0, REFERENCE_V) - truth.thrust(-1.0, REFERENCE_V)) / 2.0
        half = size * truth.mass / slope
    else:
        half = size / math.radians(truth.max_rate[axis])
    middle, is_backlash, last = outside.shape["stick"], outside.shape["is_backlash"], [0.0]

    def act(drone: Any, command: Vector) -> Vector:
        stick = command[axis]
        if is_backlash:
            stick = last[0] = max(stick - half, min(stick + half, last[0]))
        elif abs(stick - middle) < half:
            stick = middle
        return (*command[:axis], stick, *command[axis + 1 :])

    return act
