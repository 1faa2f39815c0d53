"""How effects outside the package's list are drawn: each a smooth function of one quantity.

==========  =================================================  =====================================
kind        what it is                                         how it acts, at most
==========  =================================================  =====================================
position    a thermal: a bump about a place on the way         force in the world
time        a step or a hump somewhere in the flight           thrust, or body rates
heading     waves of order 2 and 3 in the heading              force in the body's x, y, or yaw rate
airspeed    a resonance: a bump about one airspeed             force against the airspeed
attitude    a bump about one angle of tilt                     thrust lost
command     a dead zone about one stick position, or backlash  stick of one axis
periodic    a sine of 0.5 to 20 Hz                             force in the body, or body rates
stochastic  strong gusts                                       force in the world, or body rates
flapping    blades that flap: pitch with forward airspeed      body rates
cable       a cable that pulls to one side, by heading         force in the world
heating     motors that heat up with the square of thrust      thrust lost
payload     a load on a string that swings                     force in the world
==========  =================================================  =====================================

Waves in the heading begin at order 2: a steady wind, which the list has, is of order 1 in the body.
"""

import math
from collections.abc import Callable

import numpy as np

from flytrack_bench.hidden import Outside
from flytrack_bench.hidden.draws import direction, log_uniform
from flytrack_bench.hidden.laws import HEADING_ORDERS, heading_waves

SMALLEST, LARGEST = 0.3, 3.0  # amplitudes that are drawn
CIRCLE = np.linspace(-np.pi, np.pi, 3601)  # rad, headings at which the maximum is searched
Rng = np.random.Generator
Shape = dict[str, float]
ChannelAndShape = tuple[str, Shape]
AXES = ("x", "y", "z")
STICK_AXES = 4
YAW, DOWN = {"x": 0.0, "y": 0.0, "z": 1.0}, {"x": -0.0, "y": -0.0, "z": -1.0}
# Ranges of shape parameters.
MAX_LEAN, WAVE = math.radians(40.0), (0.3, 1.0)  # rad; shares of waves in the heading
RADIUS_M, MIDDLE_SHARE = (4.0, 12.0), (0.25, 0.75)
STEP_WIDTH_SHARE, HUMP_WIDTH_SHARE = (0.005, 0.05), (0.05, 0.15)
SPEED_MS, SPEED_WIDTH_MS = (4.0, 11.0), (0.7, 1.5)
TILT_DEG, TILT_WIDTH_DEG = (12.0, 40.0), (4.0, 10.0)
STICK, FREQUENCY_HZ, GUST_S = (-0.5, 0.5), (0.5, 20.0), (0.05, 0.5)
WARMING_S, STRING_M = (10.0, 30.0), (0.3, 1.0)


def _draw_position(rng: Rng) -> ChannelAndShape:
    # Mostly up or down, as thermals go.
    up = float(rng.choice([-1.0, 1.0]))
    side, lean = rng.uniform(-math.pi, math.pi), rng.uniform(0.0, MAX_LEAN)
    way = (math.sin(lean) * math.cos(side), math.sin(lean) * math.sin(side), up * math.cos(lean))
    shape = dict(zip(AXES, way, strict=True))
    return "force", shape | {
        "radius_m": rng.uniform(*RADIUS_M),
        "at_share": rng.uniform(*MIDDLE_SHARE),
    }


def _draw_time(rng: Rng) -> ChannelAndShape:
    is_step, is_thrust = rng.random() < 0.5, rng.random() < 0.5
    width = rng.uniform(*(STEP_WIDTH_SHARE if is_step else HUMP_WIDTH_SHARE))
    shape = {
        "is_step": float(is_step),
        "middle_share": rng.uniform(*MIDDLE_SHARE),
        "width_share": width,
    }
    sign = float(rng.choice([-1.0, 1.0]))
    if is_thrust:
        return "thrust", {**shape, "x": 0.0, "y": 0.0, "z": sign}
    return "rate", {**shape, **direction(*AXES)(1.0, rng)}


def _draw_heading(rng: Rng) -> ChannelAndShape:
    shape = {f"size_{order}": rng.uniform(*WAVE) for order in HEADING_ORDERS}
    shape |= {f"phase_{order}": rng.uniform(-math.pi, math.pi) for order in HEADING_ORDERS}
    shape["largest"] = float(np.abs(heading_waves(shape, CIRCLE)).max())
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
    shape = {
        "frequency_hz": log_uniform(*FREQUENCY_HZ, rng),
        "phase": rng.uniform(-math.pi, math.pi),
    }
    return ("force" if rng.random() < 0.5 else "rate"), {**shape, **direction(*AXES)(1.0, rng)}


def _draw_stochastic(rng: Rng) -> ChannelAndShape:
    return ("force" if rng.random() < 0.5 else "rate"), {"time_constant_s": rng.uniform(*GUST_S)}


DRAWS: dict[str, Callable[[Rng], ChannelAndShape]] = {
    "position": _draw_position,
    "time": _draw_time,
    "heading": _draw_heading,
    "airspeed": lambda rng: (
        "force",
        {"speed_ms": rng.uniform(*SPEED_MS), "width_ms": rng.uniform(*SPEED_WIDTH_MS)},
    ),
    "attitude": _draw_attitude,
    "command": _draw_command,
    "periodic": _draw_periodic,
    "stochastic": _draw_stochastic,
}
KINDS = tuple(DRAWS)
# Drawn by name only: laws that a learner may find (benchmarks.beyond).
DRAWS |= {
    "flapping": lambda rng: ("rate", {"x": 0.0, "y": float(rng.choice([-1.0, 1.0])), "z": 0.0}),
    "cable": lambda rng: (
        "force",
        {"phase": rng.uniform(-math.pi, math.pi), **direction(*AXES)(1.0, rng)},
    ),
    "heating": lambda rng: ("thrust", DOWN | {"warming_s": rng.uniform(*WARMING_S)}),
    "payload": lambda rng: ("force", {"string_m": rng.uniform(*STRING_M)}),
}


def draw_outside(rng: Rng, kind: str | None = None, amplitude: float | None = None) -> Outside:
    """Return an effect outside the list, of a given or drawn kind and amplitude.

    A drawn amplitude is log-uniform.

    Args:
        amplitude: as a multiple of the sensor noise in its channel.

    Raises:
        KeyError: if there is no such kind.
    """
    kind = str(rng.choice(KINDS)) if kind is None else kind
    amplitude = log_uniform(SMALLEST, LARGEST, rng) if amplitude is None else amplitude
    channel, shape = DRAWS[kind](rng)
    return Outside(kind, channel, float(amplitude), shape)
