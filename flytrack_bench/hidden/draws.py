"""How plants with hidden effects are drawn.

Each effect is drawn by its **size**, log-uniform between what a flight of a minute barely shows
under the noise of ``flytrack_bench.hidden.noise`` and what cannot be missed. ``EFFECTS`` gives the
sizes with their units.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from flytrack_bench.hidden import STICKS, Gust, Truth

Values = dict[str, float]
Rng = np.random.Generator
# What the size leaves open: shares of it on other axes and of drag along y; m; damping.
OTHER_AXES, SIDEWAYS, GROUND_M, ZETA = (0.5, 1.0), (0.7, 1.4), (0.2, 0.5), (0.4, 0.9)


class EffectRange(NamedTuple):
    """How an effect is drawn: smallest and largest size, and parameters at a size."""

    low: float
    high: float
    make: Callable[[float, Rng], Values]


def _sign(rng: Rng) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _positive(name: str) -> Callable[[float, Rng], Values]:
    return lambda size, rng: {name: size}


def direction(*names: str) -> Callable[[float, Rng], Values]:
    """Return a maker of vectors in a random direction, of the size's length."""

    def make(size: float, rng: Rng) -> Values:
        way = rng.standard_normal(len(names))
        return dict(zip(names, (size * way / np.linalg.norm(way)).tolist(), strict=True))

    return make


def _factors(*names: str) -> Callable[[float, Rng], Values]:
    """Return a maker of factors e^(+-size) on one axis, of half the size or more on the others."""

    def make(size: float, rng: Rng) -> Values:
        shares = rng.uniform(*OTHER_AXES, len(names))
        shares[rng.integers(len(names))] = 1.0
        return {
            name: math.exp(size * share * _sign(rng))
            for name, share in zip(names, shares, strict=True)
        }

    return make


def _log_factor(name: str) -> Callable[[float, Rng], Values]:
    return lambda size, rng: {name: math.exp(size * _sign(rng))}


def _drag(prefix: str, upright: tuple[float, float]) -> Callable[[float, Rng], Values]:
    """Return a maker of coefficients of body x and y near the size, and of z as shares of it."""

    def make(size: float, rng: Rng) -> Values:
        shares = (1.0, rng.uniform(*SIDEWAYS), rng.uniform(*upright))
        return {
            f"{prefix}_{axis}": float(size * share)
            for axis, share in zip("xyz", shares, strict=True)
        }

    return make


def _ground(size: float, rng: Rng) -> Values:
    return {"gain": size, "height_m": float(rng.uniform(*GROUND_M))}


def _per_axis(
    suffix: str = "", signs: tuple[float, ...] = (1.0,)
) -> Callable[[float, Rng], Values]:
    """Return a function that draws a value per axis, all of one sign.

    One axis has the size, the others half of it or more.
    """

    def make(size: float, rng: Rng) -> Values:
        shares = rng.uniform(*OTHER_AXES, len(STICKS))
        shares[rng.integers(len(STICKS))] = rng.choice(signs)
        shares = np.copysign(shares, shares[np.abs(shares).argmax()])
        return {
            name + suffix: float(size * share) for name, share in zip(STICKS, shares, strict=True)
        }

    return make


def _oscillator(size: float, rng: Rng) -> Values:
    values: Values = {}
    for name, period in _per_axis()(size, rng).items():
        damping = float(rng.uniform(*ZETA))
        values |= {f"{name}_s": 2.0 * damping * period, f"{name}_damping": damping}
    return values


# Parameters and signs are the package's where the laws agree.
EFFECTS: dict[str, EffectRange] = {
    "command_delay": EffectRange(0.0006, 0.02, _positive("delay_s")),  # s
    "thrust_lag_asymmetry": EffectRange(0.25, 1.2, _log_factor("ratio")),  # |ln ratio|
    "rate_expo": EffectRange(0.006, 0.15, _per_axis(signs=(-1.0, 1.0))),  # 1
    "rate_scale": EffectRange(0.005, 0.1, _factors(*STICKS)),  # |ln factor|
    "rate_saturation": EffectRange(0.008, 0.2, _per_axis()),  # share lost at full stick
    "rate_cross_coupling": EffectRange(0.005, 0.08, direction("from_roll", "from_pitch")),  # 1
    "motor_imbalance": EffectRange(0.0006, 0.01, direction("roll", "pitch")),  # rad/s per m/s^2
    "yaw_reaction": EffectRange(0.003, 0.05, lambda size, rng: {"angle": size * _sign(rng)}),  # rad
    "second_order_rates": EffectRange(0.002, 0.025, _oscillator),  # s, 1 / wn
    "rate_slew_limit": EffectRange(0.02, 0.25, _per_axis("_s")),  # s, centre to full stick
    # m/s^2; with drag 6 times that in m/s
    "wind": EffectRange(0.12, 1.5, direction("a_x", "a_y", "a_z")),
    "thrust_scale": EffectRange(0.01, 0.2, _log_factor("factor")),  # |ln factor|
    "translational_lift": EffectRange(0.03, 0.4, _positive("gain")),  # share of thrust
    "ground_effect": EffectRange(0.06, 0.5, _ground),  # share of thrust
    "linear_drag": EffectRange(0.03, 0.6, _drag("d", (0.2, 1.0))),  # 1/s
    "quadratic_drag": EffectRange(0.003, 0.05, _drag("k", (0.5, 2.0))),  # 1/m
    "rotor_drag": EffectRange(0.003, 0.05, _positive("h")),  # s/m
    "thrust_tilt": EffectRange(0.008, 0.12, direction("towards_x", "towards_y")),  # rad
    "voltage_sag": EffectRange(0.01, 1.0, _positive("at_full_v")),  # V at full thrust
    "accelerometer_bias": EffectRange(0.12, 1.5, direction("x", "y", "z")),  # m/s^2
    "accelerometer_scale": EffectRange(0.008, 0.12, _factors("x", "y", "z")),  # |ln factor|
    "gyro_bias": EffectRange(0.006, 0.1, direction("x", "y", "z")),  # rad/s
    "gyro_scale": EffectRange(0.005, 0.1, _factors("x", "y", "z")),  # |ln factor|
    "imu_offset": EffectRange(0.005, 0.06, direction("x", "y", "z")),  # m
    "imu_latency": EffectRange(0.0006, 0.015, _positive("latency_s")),  # s
}
NAMES = tuple(EFFECTS)
DRAGS = ("linear_drag", "quadratic_drag", "rotor_drag")
# What a prop strike, a lost part or a broken motor brings about in flight.
SUDDEN = ("motor_imbalance", "thrust_scale", "linear_drag", "rate_scale", "thrust_tilt")
ONSET_SHARE = (0.25, 0.75)  # of the log
MAX_LATE_S = 0.04  # of motion capture
AIR_PER_PUSH = 6.0  # m/s of wind per m/s^2 of its size, where there is drag
# Base parameters, log-uniform or uniform. The thrust curve is given at REFERENCE_V.
TAU_S = (0.015, 0.07)
FULL_THRUST_N, IDLE_THRUST_N, REFERENCE_V = (28.0, 45.0), (0.3, 1.0), 23.0
CURVED, CUBIC = (0.3, 0.75), (-0.03, 0.03)  # shares of the thrust between idle and full
PER_VOLT, PER_VOLT_STICK = (0.4, 0.9), (0.3, 0.9)  # N/V
GUST_STD, GUST_S = (0.3, 1.5), (0.3, 3.0)  # m/s^2, s
GUST_RATE_STD = (0.02, 0.1)  # rad/s


def log_uniform(low: float, high: float, rng: Rng) -> float:
    """Return a number whose logarithm is uniform."""
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def draw_base(rng: Rng) -> Truth:
    """Return a plant without effects: lags and thrust curve are drawn, the rest is the handout's.

    Lags are between 15 and 70 ms.
    """
    tau = tuple(log_uniform(*TAU_S, rng) for _ in range(4))
    full, idle = rng.uniform(*FULL_THRUST_N), rng.uniform(*IDLE_THRUST_N)
    curved, cubic = rng.uniform(*CURVED), rng.uniform(*CUBIC)
    volt, both = rng.uniform(*PER_VOLT), rng.uniform(*PER_VOLT_STICK)
    span = full - idle
    # With s = (1 + u) / 2: idle + span ((1 - curved) s + curved s^2 + cubic (u^3 - u)) at the
    # reference.
    constant = idle + span * ((1.0 - curved) / 2.0 + curved / 4.0)
    linear = span * ((1.0 - curved) / 2.0 + curved / 2.0 - cubic)
    coeffs = (
        constant - volt * REFERENCE_V,
        linear - both * REFERENCE_V,
        span * curved / 4.0,
        span * cubic,
        volt,
        both,
    )
    return Truth(tau, tuple(float(value) for value in coeffs))


def draw_effect(name: str, rng: Rng, size: float | None = None, has_drag: bool = False) -> Values:
    """Return an effect's parameters, in a random direction; the size is drawn if not given.

    Args:
        has_drag: whether the plant has drag: wind is then moving air, else a steady push.

    Raises:
        KeyError: if there is no such effect.
    """
    drawn = EFFECTS[name]
    size = log_uniform(drawn.low, drawn.high, rng) if size is None else size
    values = drawn.make(size, rng)
    if name == "wind" and has_drag:
        return {key.replace("a_", "v_"): AIR_PER_PUSH * value for key, value in values.items()}
    return values


def draw_larger_size(name: str, rng: Rng) -> float:
    """Return a size of an effect from the larger half of its range."""
    drawn = EFFECTS[name]
    return log_uniform(math.sqrt(drawn.low * drawn.high), drawn.high, rng)


def with_effects(truth: Truth, names: tuple[str, ...], rng: Rng) -> Truth:
    """Return the plant with these effects added, drawn in this order."""
    has_drag = any(name in DRAGS for name in (*names, *truth.effects))
    effects = {name: draw_effect(name, rng, has_drag=has_drag) for name in names}
    return replace(truth, effects={**truth.effects, **effects})


def draw_truth(rng: Rng, num_effects: int) -> Truth:
    """Return a plant with this many different effects."""
    names = rng.choice(NAMES, size=num_effects, replace=False)
    return with_effects(draw_base(rng), tuple(str(name) for name in names), rng)


def draw_gust(rng: Rng) -> Gust:
    """Return gusts of 0.3 to 1.5 m/s^2 that last 0.3 to 3 s; half of them also turn the drone."""
    rate_std = log_uniform(*GUST_RATE_STD, rng) if rng.random() < 0.5 else 0.0
    return Gust(log_uniform(*GUST_STD, rng), log_uniform(*GUST_S, rng), rate_std)


def draw_onset(rng: Rng, seconds: float) -> Truth:
    """Return a plant with one effect, of the larger half of sizes, that begins within a log."""
    truth, name = draw_base(rng), str(rng.choice(SUDDEN))
    size = draw_larger_size(name, rng)
    onset_s = seconds * float(rng.uniform(*ONSET_SHARE))
    return replace(truth, effects={name: draw_effect(name, rng, size)}, onset_s=onset_s)


def draw_late(rng: Rng) -> Truth:
    """Return a plant without effects whose motion capture is logged up to 40 ms late."""
    return replace(draw_base(rng), mocap_late_s=float(rng.uniform(0.0, MAX_LATE_S)))
