"""The options of ``reset``: where an episode starts, and the track (docs/gymnasium.md)."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_env import state as layout
from flytrack_env.battery import Battery
from flytrack_env.effects import ROUNDING
from flytrack_env.params import RANGES
from flytrack_env.tracks import Course, Track

TRACK, BATTERY_V = "track", "battery_v"
POSE_NAMES = ("position", "quaternion", "yaw_deg", "velocity", "gate_index")
NAMES = (*POSE_NAMES, BATTERY_V, TRACK)
UNIT_NORM_TOLERANCE = 1e-3
MAX_SPEED = RANGES["reset.course_speed"].high
MAX_FLOAT32 = float(np.finfo(np.float32).max)
IDLE_ROTORS = (0.0, 0.0, 0.0, -1.0)


def check_names(options: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the options as a dict; none is an empty one.

    Raises:
        ValueError: not a mapping, an unknown name, or a quaternion together with a yaw.
    """
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise ValueError(f"options: found {type(options).__name__}, expected a dict")
    for name in options:
        if name not in NAMES:
            raise ValueError(f"options: found {name!r}, expected one of {', '.join(NAMES)}")
    if "quaternion" in options and "yaw_deg" in options:
        raise ValueError("options: found quaternion and yaw_deg, expected one of them")
    if not isinstance(options.get(TRACK, ""), (str, Path, Track)):
        found = type(options[TRACK]).__name__
        raise ValueError(f"options[{TRACK!r}]: found {found}, expected a name, a path or a Track")
    return dict(options)


def read_start(options: Mapping[str, Any], course: Course, battery: Battery) -> dict[str, Any]:
    """Return the start that checked options ask for on a course; what is not in it is drawn.

    Returns:
        ``drone``, (21,) laid out as in ``flytrack_env.state``, with ``gate_index``, the gate to fly
        first; and ``battery_v``, V.

    Raises:
        ValueError: a value that no episode can start with; it names option, found and expected.
    """
    start: dict[str, Any] = {}
    if BATTERY_V in options:
        battery_v = _numbers(options, BATTERY_V, 0)
        if not battery.empty_v < battery_v <= battery.full_v * (1.0 + ROUNDING):
            expected = f"above {battery.empty_v:g} and up to {battery.full_v:g} V"
            raise _error(BATTERY_V, options, expected)
        start["battery_v"] = np.float32(battery_v)
    if any(name in options for name in POSE_NAMES):
        drone = np.zeros(layout.STATE_SIZE, np.float32)
        drone[layout.POSITION] = _position(options, course)
        drone[layout.QUATERNION] = _quaternion(options, course)
        drone[layout.VELOCITY] = _velocity(options)
        drone[layout.APPLIED_ACTION] = IDLE_ROTORS
        drone[layout.BATTERY] = battery.full_v
        start |= {"drone": drone, "gate_index": np.int32(_gate_index(options, course.num_gates))}
    return start


def _position(options: Mapping[str, Any], course: Course) -> Any:
    if "position" not in options:
        return course.start_pos_w
    position = _numbers(options, "position", 3)
    low, high = np.array(course.bounds_low), np.array(course.bounds_high)
    if not ((position >= low) & (position <= high)).all():
        raise _error("position", options, f"within the bounds, {low.tolist()} to {high.tolist()} m")
    return position


def _quaternion(options: Mapping[str, Any], course: Course) -> Any:
    if "yaw_deg" in options:
        half = 0.5 * math.radians(_numbers(options, "yaw_deg", 0))
        return math.cos(half), 0.0, 0.0, math.sin(half)
    if "quaternion" not in options:
        return course.start_quat
    quaternion = _numbers(options, "quaternion", 4)
    norm = np.linalg.norm(quaternion)
    if abs(norm - 1.0) > UNIT_NORM_TOLERANCE:
        raise _error("quaternion", options, f"norm 1 within {UNIT_NORM_TOLERANCE:g}")
    return quaternion / norm


def _velocity(options: Mapping[str, Any]) -> Any:
    velocity = _numbers(options, "velocity", 3) if "velocity" in options else np.zeros(3)
    if not (abs(velocity) <= MAX_SPEED).all():
        raise _error("velocity", options, f"at most {MAX_SPEED:g} m/s along every axis")
    return velocity


def _gate_index(options: Mapping[str, Any], num_gates: int) -> int:
    index = options.get("gate_index", 0)
    is_integer = isinstance(index, (int, np.integer)) and not isinstance(index, bool)
    if not is_integer or not 0 <= index < num_gates:
        raise _error("gate_index", options, f"an integer from 0 to {num_gates - 1}")
    return int(index)


def _numbers(options: Mapping[str, Any], name: str, size: int) -> np.ndarray:
    """Return a number (size 0), or that many, finite as float32; float64."""
    expected = f"{size} finite numbers" if size else "a finite number"
    try:
        values = np.asarray(options[name])
    except ValueError as error:  # ragged lists
        raise _error(name, options, expected) from error
    is_right_shape = values.shape == ((size,) if size else ())
    if (
        not is_right_shape
        or values.dtype.kind not in "fiu"
        or not (abs(values) < MAX_FLOAT32).all()
    ):
        raise _error(name, options, expected)
    return values.astype(float)


def _error(name: str, options: Mapping[str, Any], expected: str) -> ValueError:
    return ValueError(f"options[{name!r}]: found {options[name]!r}, expected {expected}")
