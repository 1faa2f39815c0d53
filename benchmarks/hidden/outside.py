"""Effects outside the package's list, and their random draws: each a smooth function of one quantity.

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
flapping       blades that flap: pitch with forward airspeed       body rates
cable          a cable that pulls to one side, by heading          force in the world
heating        motors that heat up with the square of thrust       thrust lost
payload        a load on a string that swings                      force in the world
=============  ==================================================  =======================================

Waves in the heading begin at order 2: a steady wind, which the list has, is of order 1 in the body.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.hidden.noise import STD
from benchmarks.hidden.truth import GRAVITY, Outside, Truth, direction, log_uniform
from benchmarks.hidden.vectors import Vector, norm, scale, to_body

# An amplitude of 1: m/s^2 of forces and of thrust over mass, rad/s of rates.
SCALES = {"force": STD["f"], "thrust": STD["f"], "rate": STD["w"]}
SMALLEST, LARGEST = 0.3, 3.0  # amplitudes that are drawn
HEADING_ORDERS = (2, 3)
CIRCLE = np.linspace(-np.pi, np.pi, 3601)  # rad, headings at which the maximum is searched
REFERENCE_V = 23.0  # at which the slope of the thrust turns a force into a share of the stick
TINY_SPEED = 1e-6  # m/s, keeps 0 / 0 away
Rng = np.random.Generator
Shape = dict[str, float]
ChannelAndShape = tuple[str, Shape]
AXES = ("x", "y", "z")
STICK_AXES = 4
YAW, DOWN = {"x": 0.0, "y": 0.0, "z": 1.0}, {"x": -0.0, "y": -0.0, "z": -1.0}
# Ranges of shape parameters.
MOST_LEAN, WAVE = math.radians(40.0), (0.3, 1.0)  # rad; shares of waves in the heading
RADIUS_M, MIDDLE_SHARE = (4.0, 12.0), (0.25, 0.75)
STEP_WIDTH_SHARE, HUMP_WIDTH_SHARE = (0.005, 0.05), (0.05, 0.15)
SPEED_MS, SPEED_WIDTH_MS = (4.0, 11.0), (0.7, 1.5)
TILT_DEG, TILT_WIDTH_DEG = (12.0, 40.0), (4.0, 10.0)
STICK, FREQUENCY_HZ, GUST_S = (-0.5, 0.5), (0.5, 20.0), (0.05, 0.5)
USUAL_SPEED_MS, DAMPING = 5.0, 0.4
WARMING_S, STRING_M = (10.0, 30.0), (0.3, 1.0)


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


def _bump(value: float, middle: float, width: float) -> float:
    return math.exp(-0.5 * ((value - middle) / width) ** 2)


def _position(shape: Any, plant: Any) -> float:
    place = zip(plant.pos_w, plant.centre_w, strict=True)
    return _bump(math.sqrt(sum((here - there) ** 2 for here, there in place)), 0.0, shape["radius_m"])


def _time(shape: Any, plant: Any) -> float:
    share, middle, width = plant.time_s / plant.duration_s, shape["middle_share"], shape["width_share"]
    is_step = shape["is_step"]
    return 0.5 + 0.5 * math.tanh((share - middle) / width) if is_step else _bump(share, middle, width)


def heading_waves(shape: Any, heading: Any, cosine: Callable[[Any], Any] = math.cos) -> Any:
    """Return the sum of waves of orders 2 and 3 in the heading, rad; cosine: of a float or of arrays."""
    return sum(shape[f"size_{n}"] * cosine(n * heading + shape[f"phase_{n}"]) for n in HEADING_ORDERS)


def _heading(shape: Any, plant: Any) -> float:
    return heading_waves(shape, math.atan2(plant.rows[1][0], plant.rows[0][0])) / shape["largest"]


def _attitude(shape: Any, plant: Any) -> float:
    tilt_deg = math.degrees(math.acos(max(-1.0, min(1.0, plant.rows[2][2]))))
    return _bump(tilt_deg, shape["tilt_deg"], shape["width_deg"])


def _periodic(shape: Any, plant: Any) -> float:
    return math.sin(2.0 * math.pi * shape["frequency_hz"] * plant.time_s + shape["phase"])


def _heating(shape: Any, plant: Any) -> float:
    """Return half of a temperature that follows the square of the thrust; it is kept in the plant."""
    now, last, warmth = plant.time_s, *getattr(plant, "heat", (plant.time_s, 0.0))
    warmth += -math.expm1(-(now - last) / shape["warming_s"]) * ((plant.thrust_acc / GRAVITY) ** 2 - warmth)
    plant.heat = now, warmth
    return 0.5 * warmth


def _payload(plant: Any, shape: Any) -> Vector:
    """Return how far a pendulum with the drone's acceleration is off, world, over its usual swing."""
    now, last, off, speed = plant.time_s, *getattr(plant, "swing", (plant.time_s, (0.0,) * 3, (0.0,) * 3))
    step_s, stiffness = now - last, GRAVITY / shape["string_m"]
    pull = tuple(
        -acc - stiffness * x - DAMPING * v for acc, x, v in zip(plant.acc_w, off, speed, strict=True)
    )
    speed = tuple(v + step_s * a for v, a in zip(speed, pull, strict=True))
    off = tuple(x + step_s * v for x, v in zip(off, speed, strict=True))
    plant.swing = now, off, speed
    return scale(1.0 / shape["string_m"], (off[0], off[1], 0.0))


def noise_hook(process: FirstOrderNoise, size: float, channel: str) -> Callable[[Any], Vector]:
    """Return a hook that adds what a process has now: as a force of the world, or as body rates."""
    if channel == "rate":
        return lambda plant: scale(size, process.now)
    return lambda plant: to_body(plant.rows, scale(size, process.now))


def vector_hook(outside: Outside) -> Callable[[Any], Vector]:
    """Return a hook that adds a force, body, m/s^2, or body rates, rad/s; not of kind "stochastic"."""
    size, shape = outside.amplitude * SCALES[outside.channel], outside.shape
    signal = TABLE[outside.kind][2]
    if outside.kind == "airspeed":

        def against(plant: Any) -> Vector:
            speed = max(norm(plant.airspeed_b), TINY_SPEED)
            return scale(-size * signal(shape, plant) / speed, plant.airspeed_b)

        return against
    if outside.kind == "payload":
        return lambda plant: to_body(plant.rows, scale(size, _payload(plant, shape)))
    way = (shape["x"], shape["y"], shape["z"])
    if outside.kind in ("position", "cable"):
        return lambda plant: to_body(plant.rows, scale(size * signal(shape, plant), way))
    return lambda plant: scale(size * signal(shape, plant), way)


def command_hook(outside: Outside, truth: Truth) -> Callable[[Any, tuple], tuple]:
    """Return a hook on commands: a dead zone or backlash of one stick."""
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


def _draw_position(rng: Rng) -> ChannelAndShape:
    # Mostly up or down, as thermals go.
    up = float(rng.choice([-1.0, 1.0]))
    side, lean = rng.uniform(-math.pi, math.pi), rng.uniform(0.0, MOST_LEAN)
    way = (math.sin(lean) * math.cos(side), math.sin(lean) * math.sin(side), up * math.cos(lean))
    shape = dict(zip(AXES, way, strict=True))
    return "force", shape | {"radius_m": rng.uniform(*RADIUS_M), "at_share": rng.uniform(*MIDDLE_SHARE)}


def _draw_time(rng: Rng) -> ChannelAndShape:
    is_step, is_thrust = rng.random() < 0.5, rng.random() < 0.5
    width = rng.uniform(*(STEP_WIDTH_SHARE if is_step else HUMP_WIDTH_SHARE))
    shape = {"is_step": float(is_step), "middle_share": rng.uniform(*MIDDLE_SHARE), "width_share": width}
    sign = float(rng.choice([-1.0, 1.0]))
    if is_thrust:
        return "thrust", {**shape, "x": 0.0, "y": 0.0, "z": sign}
    return "rate", {**shape, **direction(*AXES)(1.0, rng)}


def _draw_heading(rng: Rng) -> ChannelAndShape:
    shape = {f"size_{order}": rng.uniform(*WAVE) for order in HEADING_ORDERS}
    shape |= {f"phase_{order}": rng.uniform(-math.pi, math.pi) for order in HEADING_ORDERS}
    shape["largest"] = float(np.abs(heading_waves(shape, CIRCLE, np.cos)).max())
    if rng.random() < 0.5:
        return "force", {**shape, **direction("x", "y")(1.0, rng), "z": 0.0}
    return "rate", {**shape, **YAW}


def _draw_attitude(rng: Rng) -> ChannelAndShape:
    shape = {"tilt_deg": rng.uniform(*TILT_DEG), "width_deg": rng.uniform(*TILT_WIDTH_DEG)}
    return "thrust", {**shape, **DOWN}


def _draw_command(rng: Rng) -> ChannelAndShape:
    axis = int(rng.integers(STICK_AXES))
    shape = {"axis": axis, "stick": rng.uniform(*STICK), "is_backlash": float(rng.random() < 0.5)}
    return "thrust" if axis == STICK_AXES - 1 else "rate", shape


def _draw_periodic(rng: Rng) -> ChannelAndShape:
    shape = {"frequency_hz": log_uniform(*FREQUENCY_HZ, rng), "phase": rng.uniform(-math.pi, math.pi)}
    return ("force" if rng.random() < 0.5 else "rate"), {**shape, **direction(*AXES)(1.0, rng)}


def _draw_stochastic(rng: Rng) -> ChannelAndShape:
    return ("force" if rng.random() < 0.5 else "rate"), {"time_constant_s": rng.uniform(*GUST_S)}


# Kind -> what it is a function of, its draw, and its signal where it has one.
TABLE: dict[str, tuple[str, Callable[[Rng], ChannelAndShape], Callable[[Any, Any], float] | None]] = {
    "position": ("position", _draw_position, _position),
    "time": ("time", _draw_time, _time),
    "heading": ("heading", _draw_heading, _heading),
    "airspeed": (
        "airspeed",
        lambda rng: ("force", {"speed_ms": rng.uniform(*SPEED_MS), "width_ms": rng.uniform(*SPEED_WIDTH_MS)}),
        lambda shape, plant: _bump(norm(plant.airspeed_b), shape["speed_ms"], shape["width_ms"]),
    ),
    "attitude": ("tilt", _draw_attitude, _attitude),
    "command": ("command", _draw_command, None),
    "periodic": ("frequency", _draw_periodic, _periodic),
    "stochastic": ("chance", _draw_stochastic, None),
}
KINDS = tuple(TABLE)
# Drawn by name only: laws that a learner may find (benchmarks.beyond).
TABLE |= {
    "flapping": (
        "airspeed",
        lambda rng: ("rate", {"x": 0.0, "y": float(rng.choice([-1.0, 1.0])), "z": 0.0}),
        lambda shape, plant: plant.airspeed_b[0] / USUAL_SPEED_MS,
    ),
    "cable": (
        "heading",
        lambda rng: ("force", {"phase": rng.uniform(-math.pi, math.pi), **direction(*AXES)(1.0, rng)}),
        lambda shape, plant: math.cos(math.atan2(plant.rows[1][0], plant.rows[0][0]) + shape["phase"]),
    ),
    "heating": ("time", lambda rng: ("thrust", DOWN | {"warming_s": rng.uniform(*WARMING_S)}), _heating),
    "payload": ("airspeed", lambda rng: ("force", {"string_m": rng.uniform(*STRING_M)}), None),
}


def draw_outside(rng: Rng, kind: str | None = None, amplitude: float | None = None) -> Outside:
    """Return an effect outside the list; kind and amplitude are drawn if not given, the latter log-uniform.

    amplitude: as a multiple of the sensor noise in its channel.

    Raises:
        KeyError: if there is no such kind.
    """
    kind = str(rng.choice(KINDS)) if kind is None else kind
    amplitude = log_uniform(SMALLEST, LARGEST, rng) if amplitude is None else amplitude
    depends_on, draw, _ = TABLE[kind]
    channel, shape = draw(rng)
    return Outside(kind, (depends_on,), channel, float(amplitude), shape)
