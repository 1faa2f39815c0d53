"""Body rates that change no faster than the torque allows."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, Range, StepContext
from flytrack_env.quaternion import Scalar, Vec3


class RateSlewLimit(NamedTuple):
    """Inverse of the largest angular acceleration, s^2/rad: 0 is no limit."""

    inverse: Scalar = 0.0


def _rates(limit: RateSlewLimit, memory: None, rates_b: Vec3, context: StepContext) -> Vec3:
    def limited(rate: Scalar, before: Scalar) -> Scalar:
        change = rate - before
        is_beyond = limit.inverse * jnp.abs(change) > context.dt
        # Guard inside the where: dt / 0 has no slope even where it is not selected.
        largest = context.dt / jnp.where(is_beyond, limit.inverse, 1.0)
        return jnp.where(is_beyond, before + jnp.sign(change) * largest, rate)

    pairs = zip(rates_b, context.drone.rates_b, strict=True)
    return Vec3(*(limited(rate, before) for rate, before in pairs))


RATE_SLEW_LIMIT = Effect(
    name="rate_slew_limit",
    parameters=RateSlewLimit,
    ranges={"inverse": Range(0.0, 0.1, "s^2/rad")},
    notable={"inverse": 0.005},
    equation=r"|\omega_i(t + \Delta t) - \omega_i(t)| \le \frac{\Delta t}{\text{inverse}}",
    source="assumption: the same on all axes, at any thrust",
    probes={"inverse": (0.003, 0.01, 0.03)},
    rates=_rates,
)
