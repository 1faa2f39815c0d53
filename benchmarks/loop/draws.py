"""Which plants the loop is measured on: the handout's drone, not quite, with effects drawn from a seed."""

import math
from dataclasses import replace

import numpy as np

from benchmarks.hidden import Truth, draw_effect
from benchmarks.hidden.draws import EFFECTS as DRAWN
from benchmarks.loop.plant import EFFECTS
from flytrack_env import nominal_parameters

LAG_SPREAD, THRUST_SPREAD = 0.2, 0.05  # |ln factor| of the lags, and of the thrust map, at most
LARGE = 2.0 / 3.0  # of the way from the smallest size to the largest, on a log scale: the least that is drawn
# What the first plants have: one effect of the three that every drone has, or a number of drawn ones.
HIDDEN = (("command_delay",), ("quadratic_drag",), ("thrust_scale",), 2, 3)
LATER = 5  # effects of every plant after these, drawn: together they matter more often


def _size(name: str, rng: np.random.Generator) -> float:
    """Return a size from the upper third of what is drawn: the loop is for what matters."""
    low, high = math.log(DRAWN[name].low), math.log(DRAWN[name].high)
    return math.exp(rng.uniform(low + LARGE * (high - low), high))


def _drawn(name: str, rng: np.random.Generator) -> dict[str, float]:
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
    """Return a plant by its number, from 0: what is hidden follows ``HIDDEN``, how large it is the seed."""
    rng = np.random.default_rng([seed, number])
    hidden = HIDDEN[number] if number < len(HIDDEN) else LATER
    if isinstance(hidden, int):
        hidden = tuple(str(name) for name in rng.choice(EFFECTS, size=hidden, replace=False))
    base = draw_base(rng)
    return replace(base, effects={name: _drawn(name, rng) for name in hidden})
