"""Scales of channels: units, and factors that no unit has."""

from typing import NamedTuple

import numpy as np

from flytrack_sysid.check.explain import Change
from flytrack_sysid.check.motion import correlations_of, useful_windows
from flytrack_sysid.kinematics import GRAVITY, WEIGHT_W, attitude_of, summed_turns
from flytrack_sysid.log import FlightLog

MIN_CORRELATION = 0.9  # below, the slope may be that of noise
# Scales within this factor of 1 are those of sensors and estimators: measured flights have 0.73 to
# 1.25 (Crazyflies whose velocity is a slow estimate).
LIKELY = 1.4
FAST_PERCENTILE = 99.0  # of the rates: an isolated spike does not show a wrong unit
FASTEST_RATE = float(np.deg2rad(4000.0))  # rad/s, the widest range among common gyroscopes
UNIT_TOLERANCE = 0.15  # relative, of a unit's factor
UNITS = {  # logged numbers for 1 in SI units
    "w": {"deg/s": 180.0 / np.pi, "gyro counts of 2000 deg/s": 16.4 * 180.0 / np.pi},
    "f": {
        "g": 1.0 / GRAVITY,
        "mg": 1e3 / GRAVITY,
        "mm/s^2": 1e3,
        "cm/s^2": 1e2,
        "counts of 16 g": 2048.0 / GRAVITY,
    },
    "v": {"cm/s": 1e2, "mm/s": 1e3, "km/h": 3.6, "ft/s": 1.0 / 0.3048},
    "p": {"cm": 1e2, "mm": 1e3, "ft": 1.0 / 0.3048},
    "v_bat": {"mV": 1e3, "hundredths of V": 1e2, "tenths of V": 10.0},
}
MIN_SPREAD = 1.0  # m/s^2, rms of the accelerations that show the scale of a velocity


class Slope(NamedTuple):
    """The scale of a quantity over that of another.

    Attributes:
        factor: NaN where the motion does not show it.
        by_axis: of each axis, (3,).
    """

    factor: float
    by_axis: np.ndarray


UNKNOWN = Slope(np.nan, np.full(3, np.nan))


def slope_between(log: FlightLog, sums: np.ndarray, rates: np.ndarray) -> Slope:
    """Return the sizes of a rate's integrals over those of the changes of a quantity.

    Where both are highly correlated, noise in either biases the slope little.

    Args:
        log: the log that holds the rows.
        sums: a quantity, (num_rows, 3).
        rates: its derivative times a factor, (num_rows, 3).
    """
    best, slope = 0.0, UNKNOWN
    for _, windows in useful_windows(log):
        shown = windows.mean_rate(sums)
        measured = windows.mean_of(log, rates)
        sizes = np.linalg.norm(shown, axis=0), np.linalg.norm(measured, axis=0)
        total = np.linalg.norm(sizes[0]), np.linalg.norm(sizes[1])
        correlation = np.sum(shown * measured) / max(total[0] * total[1], 1e-12)
        if correlation > max(best, MIN_CORRELATION):
            is_clear = np.diag(correlations_of(shown, measured)) > MIN_CORRELATION
            by_axis = np.where(is_clear, sizes[1] / np.maximum(sizes[0], 1e-12), np.nan)
            best, slope = float(correlation), Slope(float(total[1] / total[0]), by_axis)
    return slope


def scales_of_forces(log: FlightLog) -> tuple[float, float]:
    """Return the scales of velocity and accelerometer; NaN where the motion does not show one.

    The change of the velocity is regressed on the rotated force and on gravity: with scales s_v and
    s_f it is (s_v / s_f) R f - s_v g.
    """
    force_w = attitude_of(log).apply(log["f"])
    found = np.nan, np.nan
    best = MIN_CORRELATION**2
    for _, windows in useful_windows(log):
        changes = windows.mean_rate(log["v"])
        means = windows.mean_of(log, force_w)
        design = np.stack([means.ravel(), np.tile(-WEIGHT_W, len(means))], axis=1)
        (a, b), *_ = np.linalg.lstsq(design, changes.ravel(), rcond=None)
        residual = np.sum((changes.ravel() - design @ [a, b]) ** 2)
        explained = 1.0 - residual / max(np.sum(changes**2), 1e-12)
        if explained > best and a > 0.0 and b > 0.0:
            best = explained
            if np.sqrt(np.mean(np.sum(changes**2, axis=1))) / b > MIN_SPREAD:
                found = float(b), float(b / a)
    return found


def unit_of(channel: str, factor: float) -> str:
    """Return the unit that a factor looks like, or that SI units were read as; "" for neither."""
    for name, size in _units_of(channel).items():
        if abs(factor / size - 1.0) < UNIT_TOLERANCE:
            return name
        if abs(factor * size - 1.0) < UNIT_TOLERANCE:
            return f"SI units, read as {name}"
    return ""


def _units_of(channel: str) -> dict[str, float]:
    return UNITS.get(channel if channel == "v_bat" else channel[:1], {})


def snapped(channel: str, factor: float) -> float:
    """Return the factor of the unit that a factor looks like, or itself."""
    sizes = _units_of(channel).values()
    factors = [*sizes, *(1.0 / size for size in sizes)]
    return next((one for one in factors if abs(factor / one - 1.0) < UNIT_TOLERANCE), factor)


def is_unlikely(factor: float) -> bool:
    """Return whether no sensor has a scale; False for NaN."""
    return not np.isnan(factor) and not 1.0 / LIKELY < factor < LIKELY


def scale_changes(log: FlightLog) -> list[tuple[Change, ...]]:
    """Return the channels of wrong scale, as alternatives; [()] if there are none.

    Args:
        log: with right axes.
    """
    found: list[Change] = []
    speed, force = np.nan, np.nan
    if "q" in log and "w" in log:
        turns = summed_turns(attitude_of(log))
        found += _by_axis("w", slope_between(log, turns, log["w"]))
    elif "w" in log:
        fast = float(np.percentile(np.linalg.norm(log["w"], axis=1), FAST_PERCENTILE))
        found += [Change("w", "scale", UNITS["w"]["deg/s"])] * (fast > FASTEST_RATE)
    if all(name in log for name in ("q", "v", "f")):
        speed, force = scales_of_forces(log)
    if "f" in log and np.isnan(force):
        # In flight the mean force is about the weight.
        force = float(np.median(np.linalg.norm(log["f"], axis=1))) / GRAVITY
        force = force if unit_of("f", force) else np.nan
    speed = snapped("v", speed)
    found += [Change("f", "scale", snapped("f", force))] * is_unlikely(force)
    found += [Change("v", "scale", speed)] * is_unlikely(speed)
    if "p" not in log or "v" not in log:
        return [tuple(found)]
    ratio = slope_between(log, log["p"], log["v"])
    if not np.isnan(speed):
        speed = speed if is_unlikely(speed) else 1.0
        position = Slope(speed / ratio.factor, speed / ratio.by_axis)
        return [(*found, *_by_axis("p", position))]
    slower = _by_axis("p", Slope(1.0 / ratio.factor, 1.0 / ratio.by_axis))
    faster = _by_axis("v", ratio)
    alternatives = [(*found, *slower), (*found, *faster)] if slower and faster else [tuple(found)]
    named = [one for one in alternatives if all(unit_of(c.channel, float(c.value)) for c in one)]
    return named or alternatives


def _by_axis(channel: str, slope: Slope) -> list[Change]:
    """Return the changes of a channel whose axes have scales, one if all have the same."""
    if np.isnan(slope.factor):
        return []
    if is_unlikely(slope.factor):
        return [Change(channel, "scale", snapped(channel, slope.factor))]
    return [
        Change(f"{channel}_{axis}", "scale", float(factor))
        for axis, factor in zip("xyz", slope.by_axis, strict=True)
        if is_unlikely(factor)
    ]
