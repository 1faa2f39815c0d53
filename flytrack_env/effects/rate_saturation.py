"""Body rates that end below what full stick asks for: motors or the flight controller give no more."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, Range, StepContext
from flytrack_env.quaternion import Scalar, Vec3

CENTRED = 1e-6  # of a stick: nothing saturates there, and nothing is divided by 0


class RateSaturation(NamedTuple):
    """Share of full stick, at its end, that turns no faster, 1, and how gradually, 0 (a corner) to 1."""

    lost: Scalar = 0.0
    softness: Scalar = 0.5


def _rates(limit: RateSaturation, memory: None, rates_b: Vec3, context: StepContext) -> Vec3:
    reachable = 1.0 - limit.lost
    bend = 1.0 / (reachable * reachable) - 1.0

    def limited(rate: Scalar, stick: Scalar) -> Scalar:
        size = jnp.maximum(jnp.abs(stick), CENTRED)
        corner = jnp.where(size > reachable, reachable / size, 1.0)
        gradual = 1.0 / jnp.sqrt(1.0 + bend * size * size)
        return rate * (corner + limit.softness * (gradual - corner))

    return Vec3(*(limited(rate, stick) for rate, stick in zip(rates_b, context.applied[:3], strict=True)))


RATE_SATURATION = Effect(
    name="rate_saturation",
    parameters=RateSaturation,
    ranges={"lost": Range(0.0, 0.9, "1"), "softness": Range(0.0, 1.0, "1")},
    notable={"lost": 0.05},
    equation=r"\omega_i = \omega_{\max,i} \left( (1 - s) \operatorname{clip}(u_i, -L, L) + \frac{s\, "
    r"u_i}{\sqrt{1 + (L^{-2} - 1)\, u_i^2}} \right), \quad L = 1 - \text{lost}, \quad s = "
    r"\text{softness}",
    source="assumption: full stick u gives L, small sticks all of theirs; the same on all axes",
    shapes=("softness",),
    probes={"lost": (0.03, 0.1, 0.3)},
    rates=_rates,
)
