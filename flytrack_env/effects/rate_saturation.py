"""Body rates that end below what full stick asks for: motors or the flight controller give no more."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, Flight, Range
from flytrack_env.quaternion import Scalar, Vec3

CENTRED = 1e-6  # of a stick: nothing saturates there, and nothing is divided by 0


class RateSaturation(NamedTuple):
    """Share of full stick, at its end, that turns no faster, 1, and how gradually: 0.05 is a corner, 1."""

    lost: Scalar = 0.0
    softness: Scalar = 0.05


def _rates(limit: RateSaturation, memory: None, rates_b: Vec3, flight: Flight) -> Vec3:
    power = 1.0 / limit.softness
    beyond = jnp.power(1.0 - limit.lost, -power) - 1.0  # 0 where nothing is lost

    def limited(rate: Scalar, stick: Scalar) -> Scalar:
        size = jnp.maximum(jnp.abs(stick), CENTRED)
        return rate * jnp.power(1.0 + beyond * jnp.power(size, power), -limit.softness)

    return Vec3(*(limited(rate, stick) for rate, stick in zip(rates_b, flight.applied[:3], strict=True)))


RATE_SATURATION = Effect(
    name="rate_saturation",
    parameters=RateSaturation,
    ranges={"lost": Range(0.0, 0.8, "1"), "softness": Range(0.05, 0.6, "1")},
    equation="omega = max_rate u (1 + ((1 - lost)^-n - 1) |u|^n)^(-1/n), n = 1 / softness, u the lagged stick",
    source="assumption: full stick gives 1 - lost, small sticks all of it; the same on all axes",
    shapes=("softness",),
    probes={"lost": (0.03, 0.1, 0.3)},
    rates=_rates,
)
