"""Hidden plants that an environment can fly, drawn from a seed; some have a law outside the package's list.

Such laws are those of ``benchmarks.hidden.outside``, for JAX; a thermal is about the world's origin. A test
compares each step with the plain floats of ``benchmarks.hidden.plant``.
"""

import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.hidden import EFFECTS as EFFECT_RANGES
from benchmarks.hidden import Truth, draw_effect, draw_outside, log_uniform
from benchmarks.hidden.outside import SCALES, TINY_SPEED, USUAL_SPEED_MS, heading_waves
from flytrack_bench.plants import Craft, HiddenPlant
from flytrack_env import nominal_parameters

EFFECTS = (
    "command_delay",
    "thrust_lag_asymmetry",
    "rate_scale",
    "thrust_scale",
    "translational_lift",
    "linear_drag",
    "quadratic_drag",
    "rotor_drag",
    "thrust_tilt",
    "voltage_sag",
)
LAG_SPREAD, THRUST_SPREAD = 0.2, 0.05  # |ln factor| of the lags, and of the thrust map, at most
LARGE = 2.0 / 3.0  # smallest size drawn, as a share of the log range
# Hidden effects of the first plants: named, or a number of random ones.
HIDDEN = (("command_delay",), ("quadratic_drag",), ("thrust_scale",), 2, 3)
LAW_AMPLITUDES = (1.0, 3.0)  # times the sensor's noise, as in benchmarks.beyond
LATER = 5  # random effects of all later plants


def _bump(value: jax.Array, middle: float, width: float) -> jax.Array:
    return jnp.exp(-0.5 * ((value - middle) / width) ** 2)


def _heading(to_world: jax.Array) -> jax.Array:
    return jnp.arctan2(to_world[1, 0], to_world[0, 0])


# Kind -> its signal, of shape, position, attitude and airspeed.
SIGNALS: dict[str, Callable[[Any, jax.Array, jax.Array, jax.Array], jax.Array]] = {
    "airspeed": lambda shape, pos_w, to_world, airspeed_b: _bump(
        jnp.linalg.norm(airspeed_b), shape["speed_ms"], shape["width_ms"]
    ),
    "attitude": lambda shape, pos_w, to_world, airspeed_b: _bump(
        jnp.rad2deg(jnp.arccos(jnp.clip(to_world[2, 2], -1.0, 1.0))), shape["tilt_deg"], shape["width_deg"]
    ),
    "heading": lambda shape, pos_w, to_world, airspeed_b: (
        heading_waves(shape, _heading(to_world), jnp.cos) / shape["largest"]
    ),
    "flapping": lambda shape, pos_w, to_world, airspeed_b: airspeed_b[0] / USUAL_SPEED_MS,
    "cable": lambda shape, pos_w, to_world, airspeed_b: jnp.cos(_heading(to_world) + shape["phase"]),
    "position": lambda shape, pos_w, to_world, airspeed_b: _bump(
        jnp.linalg.norm(pos_w), 0.0, shape["radius_m"]
    ),
}


class PlantWithLaw(HiddenPlant):
    """A hidden plant with a law of ``SIGNALS``."""

    def __init__(self, truth: Truth):
        super().__init__(craft_of(truth))
        self.outside = truth.outside

    def push(
        self, pos_w: jax.Array, to_world: jax.Array, airspeed_b: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return what the law adds; to_world: the rotation matrix of the attitude, (3, 3)."""
        outside = self.outside
        assert outside is not None
        size = outside.amplitude * SCALES[outside.channel]
        size = size * SIGNALS[outside.kind](outside.shape, pos_w, to_world, airspeed_b)
        still = jnp.zeros(3, jnp.float32)
        if outside.kind == "airspeed":
            return -size * airspeed_b / jnp.maximum(jnp.linalg.norm(airspeed_b), TINY_SPEED), still
        way = jnp.array([outside.shape[axis] for axis in "xyz"], jnp.float32)
        if outside.kind in ("position", "cable"):
            return size * (way @ to_world), still
        return (still, size * way) if outside.channel == "rate" else (size * way, still)


def plant_of(truth: Truth) -> HiddenPlant:
    """Return a plant that flies a truth."""
    return HiddenPlant(craft_of(truth)) if truth.outside is None else PlantWithLaw(truth)


def craft_of(truth: Truth) -> Craft:
    """Return the parameters of a truth's plant."""
    return Craft(*(getattr(truth, one.name) for one in fields(Craft)))


def _size(name: str, rng: np.random.Generator) -> float:
    """Return a size from the upper third of its range."""
    low, high = math.log(EFFECT_RANGES[name].low), math.log(EFFECT_RANGES[name].high)
    return math.exp(rng.uniform(low + LARGE * (high - low), high))


def _draw_values(name: str, rng: np.random.Generator) -> dict[str, float]:
    if name == "thrust_scale":  # a loss: old packs, worn propellers and payload do not add thrust
        return {"factor": math.exp(-_size(name, rng))}
    return draw_effect(name, rng, _size(name, rng))


def draw_base(rng: np.random.Generator) -> Truth:
    """Return the handout's nominal drone with other lags and another thrust map."""
    nominal = nominal_parameters()
    factors = np.exp(rng.uniform(-LAG_SPREAD, LAG_SPREAD, 4))
    thrust = math.exp(rng.uniform(-THRUST_SPREAD, THRUST_SPREAD))
    return Truth(
        tau=tuple(float(tau * factor) for tau, factor in zip(nominal.tau, factors, strict=True)),
        coeffs=tuple(float(thrust * one) for one in nominal.thrust_coeffs),
        max_rate=tuple(float(rate) for rate in nominal.max_rate),
        drain=float(nominal.battery_drain_v_per_min),
        mass=float(nominal.m),
        gravity=float(nominal.g),
    )


def draw_plant(number: int, seed: int) -> Truth:
    """Return a plant by its number, from 0: its effects follow ``HIDDEN``, their sizes the seed."""
    rng = np.random.default_rng([seed, number])
    hidden = HIDDEN[number] if number < len(HIDDEN) else LATER
    if isinstance(hidden, int):
        hidden = tuple(str(name) for name in rng.choice(EFFECTS, size=hidden, replace=False))
    base = draw_base(rng)
    return replace(base, effects={name: _draw_values(name, rng) for name in hidden})


def draw_plant_with_law(number: int, seed: int) -> Truth:
    """Return a plant by its number, from 0, with a law outside the package's list; kinds take turns."""
    rng = np.random.default_rng([seed, number, len(SIGNALS)])
    kind = tuple(SIGNALS)[number % len(SIGNALS)]
    outside = draw_outside(rng, kind, log_uniform(*LAW_AMPLITUDES, rng))
    return replace(draw_base(rng), outside=outside)
