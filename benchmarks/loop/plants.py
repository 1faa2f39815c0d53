"""Hidden drones for the loop, drawn from a seed; some have a law outside the package's list.

A thermal is about the world's origin.
"""

import math
from dataclasses import replace

import numpy as np

from benchmarks.hidden import EFFECTS as EFFECT_RANGES
from benchmarks.hidden import draw_effect, draw_outside, log_uniform
from flytrack_bench.hidden import Truth
from flytrack_bench.hidden.laws import STATELESS_KINDS
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
HIDDEN: tuple[tuple[str, ...] | int, ...] = (
    ("command_delay",),
    ("quadratic_drag",),
    ("thrust_scale",),
    2,
    3,
)
LAW_AMPLITUDES = (1.0, 3.0)  # times the sensor's noise, as in benchmarks.beyond
LATER = 5  # random effects of all later plants


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
        coeffs=tuple(float(thrust * value) for value in nominal.thrust_coeffs),
    )


def draw_plant(number: int, seed: int) -> Truth:
    """Return a plant by its number, from 0: its effects follow ``HIDDEN``, their sizes the seed."""
    rng = np.random.default_rng([seed, number])
    names: tuple[str, ...] | int = HIDDEN[number] if number < len(HIDDEN) else LATER
    if isinstance(names, int):
        names = tuple(rng.choice(EFFECTS, size=names, replace=False).tolist())
    base = draw_base(rng)
    return replace(base, effects={name: _draw_values(name, rng) for name in names})


def draw_plant_with_law(number: int, seed: int) -> Truth:
    """Return a plant by its number, from 0, with a law outside the list; kinds take turns."""
    rng = np.random.default_rng([seed, number, len(STATELESS_KINDS)])
    kind = STATELESS_KINDS[number % len(STATELESS_KINDS)]
    outside = draw_outside(rng, kind, log_uniform(*LAW_AMPLITUDES, rng))
    return replace(draw_base(rng), outside=outside)
