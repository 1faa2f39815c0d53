"""Effects that no list has: each a smooth function of something, with a random shape.

=============  ==================================================  =======================================
kind           what it is                                          how it acts, at most
=============  ==================================================  =======================================
position       a thermal: a bump about a place on the way          force in the world
time           a step or a hump somewhere in the flight            thrust, or body rates
heading        waves of order 2 and 3 in the heading               force in the body's x, y, or yaw rate
airspeed       a resonance: a bump about one airspeed              force against the airspeed
attitude       a bump about one angle of tilt                      thrust lost
command        a dead zone about one stick position, or backlash   stick of one axis
periodic       a sine of 0.5 to 20 Hz                              force in the body, or body rates
stochastic     strong gusts                                        force in the world, or body rates
=============  ==================================================  =======================================

Waves in the heading begin at order 2: a steady wind, which the list has, is of order 1 in the body.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.hidden.noise import ACCELEROMETER_STD, GYRO_STD
from benchmarks.hidden.truth import DT_S, Outside, Truth
from benchmarks.hidden.vectors import Vector, norm, scaled, to_body

DEPENDS_ON = {
    "position": ("position",),
    "time": ("time",),
    "heading": ("heading",),
    "airspeed": ("airspeed",),
    "attitude": ("tilt",),
    "command": ("command",),
    "periodic": ("frequency",),
    "stochastic": ("chance",),
}
KINDS = tuple(DEPENDS_ON)
# What an amplitude of 1 is: m/s^2 of forces and thrust over mass, rad/s of rates.
SCALES = {"force": ACCELEROMETER_STD, "thrust": ACCELEROMETER_STD, "rate": GYRO_STD}
SMALLEST, LARGEST = 0.3, 3.0  # amplitudes that are drawn
HEADING_ORDERS = (2, 3)
CIRCLE = np.linspace(-np.pi, np.pi, 3601)  # rad, headings at which the largest is looked for
REFERENCE_V = 23.0  # at which the slope of the thrust turns a force into a share of the stick
TINY_SPEED = 1e-6  # m/s, keeps 0 / 0 away


class FirstOrderNoise:
    """Independent random processes of standard deviation 1 that forget with a time constant, s."""

    def __init__(self, time_constant_s: float, rng: np.random.Generator, count: int = 3):
        self._keep = math.exp(-DT_S / time_constant_s)
        self._fresh = math.sqrt(1.0 - self._keep**2)
        self._rng = rng
        self._now = tuple(rng.standard_normal(count).tolist())

    def step(self) -> tuple[float, ...]:
        """Return the next values, 10 ms later."""
        fresh = self._rng.standard_normal(len(self._now)).tolist()
        pairs = zip(self._now, fresh, strict=True)
        self._now = tuple(self._keep * old + self._fresh * new for old, new in pairs)
        return self._now


def _bump(value: float, middle: float, width: float) -> float:
    return math.exp(-0.5 * ((value - middle) / width) ** 2)


def _direction(shape: Any) -> Vector:
    return (shape["x"], shape["y"], shape["z"])


def _position(shape: Any, plant: Any) -> float:
    place = zip(plant.pos_w, plant.centre_w, strict=True)
    return _bump(math.sqrt(sum((here - there) ** 2 for here, there in place)), 0.0, shape["radius_m"])


def _time(shape: Any, plant: Any) -> float:
    share, middle, width = plant.time_s / plant.duration_s, shape["middle_share"], shape["width_share"]
    return (
        0.5 + 0.5 * math.tanh((share - middle) / width) if shape["is_step"] else _bump(share, middle, width)
    )


def heading_waves(shape: Any, heading: Any) -> Any:
    """Return waves of the orders 2 and 3 in the heading, rad, a number or many."""
    cosine = math.cos if isinstance(heading, float) else np.cos
    orders = HEADING_ORDERS
    return sum(shape[f"size_{n}"] * cosine(n * heading + shape[f"phase_{n}"]) for n in orders)


def _heading(shape: Any, plant: Any) -> float:
    return heading_waves(shape, math.atan2(plant.rows[1][0], plant.rows[0][0])) / shape["largest"]


def _airspeed(shape: Any, plant: Any) -> float:
    return _bump(norm(plant.airspeed_b), shape["speed_ms"], shape["width_ms"])


def _attitude(shape: Any, plant: Any) -> float:
    tilt_deg = math.degrees(math.acos(max(-1.0, min(1.0, plant.rows[2][2]))))
    return _bump(tilt_deg, shape["tilt_deg"], shape["width_deg"])


def _periodic(shape: Any, plant: Any) -> float:
    return math.sin(2.0 * math.pi * shape["frequency_hz"] * plant.time_s + shape["phase"])


SIGNALS: dict[str, Callable[[Any, Any], float]] = {
    "position": _position,
    "time": _time,
    "heading": _heading,
    "airspeed": _airspeed,
    "attitude": _attitude,
    "periodic": _periodic,
}


def vector_hook(outside: Outside, rng: np.random.Generator) -> Callable[[Any], Vector]:
    """Return a function of the plant: force in the body, m/s^2, or body rates, rad/s, to be added."""
    size, shape = outside.amplitude * SCALES[outside.channel], outside.shape
    if outside.kind == "stochastic":
        process = FirstOrderNoise(shape["time_constant_s"], rng)
        if outside.channel == "rate":
            return lambda plant: scaled(size, process.step())
        return lambda plant: to_body(plant.rows, scaled(size, process.step()))
    signal = SIGNALS[outside.kind]
    if outside.kind == "airspeed":

        def against(plant: Any) -> Vector:
            speed = max(norm(plant.airspeed_b), TINY_SPEED)
            return scaled(-size * signal(shape, plant) / speed, plant.airspeed_b)

        return against
    direction = _direction(shape)
    if outside.kind == "position":
        return lambda plant: to_body(plant.rows, scaled(size * signal(shape, plant), direction))
    return lambda plant: scaled(size * signal(shape, plant), direction)


def command_hook(outside: Outside, truth: Truth) -> Callable[[Any, tuple], tuple]:
    """Return a function of the plant and its command that flattens or delays one stick."""
    axis = int(outside.shape["axis"])
    size = outside.amplitude * SCALES[outside.channel]
    if outside.channel == "thrust":
        slope = (truth.thrust(1.0, REFERENCE_V) - truth.thrust(-1.0, REFERENCE_V)) / 2.0
        half = size * truth.mass / slope
    else:
        half = size / math.radians(truth.max_rate[axis])
    middle, is_backlash, last = outside.shape["stick"], outside.shape["is_backlash"], [0.0]

    def act(plant: Any, command: tuple) -> tuple:
        stick = command[axis]
        if is_backlash:
            stick = last[0] = max(stick - half, min(stick + half, last[0]))
        elif abs(stick - middle) < half:
            stick = middle
        return (*command[:axis], stick, *command[axis + 1 :])

    return act
