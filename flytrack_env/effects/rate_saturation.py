"""Body rates that end below what full stick asks for: motors or the flight controller give no more."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, Flight, Range
from flytrack_env.quaternion import Scalar, Vec3

CENTRED = 1e-6  # of a stick: nothing saturates there, and nothing is divided by 0


class RateSaturation(NamedTuple):
    """Share of full stick, at its end, that turns no faster, 1."""

    lost: Scalar = 0.0


def _rates(limit: RateSaturation, memory: None, rates_b: Vec3, flight: Flight) -> Vec3:
    reachable = 1.0 - limit.lost

    def limited(rate: Scalar, stick: Scalar) -> Scalar:
        size = jnp.maximum(jnp.abs(stick), CENTRED)
        return jnp.where(size > reachable, rate * (reachable / size), rate)

    return Vec3(*(limited(rate, stick) for rate, stick in zip(rates_b, flight.applied[:3], strict=True)))


RATE_SATURATION = Effect(
    name="rate_saturation",
    parameters=RateSaturation,
    ranges={"lost": Range(0.0, 0.9, "1")},
    equation="omega = max_rate clip(u, -(1 - lost), 1 - lost), per axis, u the lagged stick",
    source="assumption: a hard limit, at the same share of full stick on all axes",
    probes={"lost": (0.1, 0.25, 0.5)},
    rates=_rates,
)
