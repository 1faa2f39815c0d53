"""Random effects outside the list: the shapes of ``benchmarks.hidden.outside``."""

import math
from collections.abc import Callable

import numpy as np

from benchmarks.hidden.outside import (
    CIRCLE,
    DEPENDS_ON,
    HEADING_ORDERS,
    KINDS,
    LARGEST,
    SMALLEST,
    heading_waves,
)
from benchmarks.hidden.truth import Outside

Shape = dict[str, float]
Drawn = tuple[str, Shape]  # channel and shape
Rng = np.random.Generator
AXES = ("x", "y", "z")
STICK_AXES = 4
YAW = {"x": 0.0, "y": 0.0, "z": 1.0}
UP = {"x": 0.0, "y": 0.0, "z": 1.0}
# Ranges of shapes: units in the names of what is drawn from them.
MOST_LEAN, WAVE = math.radians(40.0), (0.3, 1.0)  # rad; shares of waves in the heading
RADIUS_M, MIDDLE_SHARE = (4.0, 12.0), (0.25, 0.75)
STEP_WIDTH_SHARE, HUMP_WIDTH_SHARE = (0.005, 0.05), (0.05, 0.15)
SPEED_MS, SPEED_WIDTH_MS = (4.0, 11.0), (0.7, 1.5)
TILT_DEG, TILT_WIDTH_DEG = (12.0, 40.0), (4.0, 10.0)
STICK, FREQUENCY_HZ, GUST_S = (-0.5, 0.5), (0.5, 20.0), (0.05, 0.5)


def _way(rng: Rng, size: int = 3) -> Shape:
    """Return a random direction; in the body's x and y only if size is 2."""
    way = np.zeros(3)
    way[:size] = rng.standard_normal(size)
    return dict(zip(AXES, (way / np.linalg.norm(way)).tolist(), strict=True))


def _position(rng: Rng) -> Drawn:
    # Mostly up or down, as thermals go.
    up = float(rng.choice([-1.0, 1.0]))
    side, lean = rng.uniform(-math.pi, math.pi), rng.uniform(0.0, MOST_LEAN)
    way = (math.sin(lean) * math.cos(side), math.sin(lean) * math.sin(side), up * math.cos(lean))
    shape = dict(zip(AXES, way, strict=True))
    return "force", {
        **shape,
        "radius_m": rng.uniform(*RADIUS_M),
        "at_share": rng.uniform(*MIDDLE_SHARE),
    }


def _time(rng: Rng) -> Drawn:
    is_step, is_thrust = rng.random() < 0.5, rng.random() < 0.5
    width = rng.uniform(*(STEP_WIDTH_SHARE if is_step else HUMP_WIDTH_SHARE))
    shape = {"is_step": float(is_step), "middle_share": rng.uniform(*MIDDLE_SHARE), "width_share": width}
    sign = float(rng.choice([-1.0, 1.0]))
    if is_thrust:
        return "thrust", {**shape, "x": 0.0, "y": 0.0, "z": sign}
    return "rate", {**shape, **_way(rng)}


def _heading(rng: Rng) -> Drawn:
    shape = {f"size_{order}": rng.uniform(*WAVE) for order in HEADING_ORDERS}
    shape |= {f"phase_{order}": rng.uniform(-math.pi, math.pi) for order in HEADING_ORDERS}
    shape["largest"] = float(np.abs(heading_waves(shape, CIRCLE)).max())
    return ("force", {**shape, **_way(rng, 2)}) if rng.random() < 0.5 else ("rate", {**shape, **YAW})


def _airspeed(rng: Rng) -> Drawn:
    return "force", {"speed_ms": rng.uniform(*SPEED_MS), "width_ms": rng.uniform(*SPEED_WIDTH_MS)}


def _attitude(rng: Rng) -> Drawn:
    shape = {"tilt_deg": rng.uniform(*TILT_DEG), "width_deg": rng.uniform(*TILT_WIDTH_DEG)}
    return "thrust", {**shape, **{axis: -part for axis, part in UP.items()}}


def _command(rng: Rng) -> Drawn:
    axis = int(rng.integers(STICK_AXES))
    shape = {"axis": axis, "stick": rng.uniform(*STICK), "is_backlash": float(rng.random() < 0.5)}
    return "thrust" if axis == STICK_AXES - 1 else "rate", shape


def _periodic(rng: Rng) -> Drawn:
    low, high = (math.log(value) for value in FREQUENCY_HZ)
    shape = {"frequency_hz": math.exp(rng.uniform(low, high)), "phase": rng.uniform(-math.pi, math.pi)}
    return ("force" if rng.random() < 0.5 else "rate"), {**shape, **_way(rng)}


def _stochastic(rng: Rng) -> Drawn:
    return ("force" if rng.random() < 0.5 else "rate"), {"time_constant_s": rng.uniform(*GUST_S)}


SHAPES: dict[str, Callable[[Rng], Drawn]] = {
    "position": _position,
    "time": _time,
    "heading": _heading,
    "airspeed": _airspeed,
    "attitude": _attitude,
    "command": _command,
    "periodic": _periodic,
    "stochastic": _stochastic,
}


def draw_outside(rng: Rng, kind: str | None = None, amplitude: float | None = None) -> Outside:
    """Return an effect outside the list; what is not given is drawn, the amplitude log-uniform in 0.3 to 3.

    amplitude: as a multiple of the sensor noise in its channel.

    Raises:
        KeyError: if there is no such kind.
    """
    kind = str(rng.choice(KINDS)) if kind is None else kind
    if amplitude is None:
        amplitude = math.exp(rng.uniform(math.log(SMALLEST), math.log(LARGEST)))
    channel, shape = SHAPES[kind](rng)
    return Outside(kind, DEPENDS_ON[kind], channel, float(amplitude), shape)
