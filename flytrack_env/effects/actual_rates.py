"""Betaflight's Actual rates: a slope about each stick's centre, and a faster end."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, Range, Search, on_rate_sticks
from flytrack_env.quaternion import Scalar


class ActualRates(NamedTuple):
    """Share of the rate at full stick that the slope about the centre lacks, 1.

    Expo: how late on the stick that share comes, 1.
    """

    roll: Scalar = 0.0
    pitch: Scalar = 0.0
    yaw: Scalar = 0.0
    roll_expo: Scalar = 0.0
    pitch_expo: Scalar = 0.0
    yaw_expo: Scalar = 0.0


def _curve(stick: Scalar, bend: Scalar, expo: Scalar) -> Scalar:
    size = jnp.abs(stick)
    late = size * (expo * size**4 + 1.0 - expo)
    return stick * (1.0 - bend * (1.0 - late))


ACTUAL_RATES = Effect(
    name="actual_rates",
    parameters=ActualRates,
    ranges={name: Range(0.0, 1.0, "1") for name in ActualRates._fields},
    notable=dict.fromkeys(ActualRates._fields[:3], 0.05),
    equation=r"u_i \leftarrow u_i \left( 1 - b_i + b_i |u_i| "
    r"\left( e_i u_i^4 + 1 - e_i \right) \right)",
    source="applyActualRates in Betaflight 4.6, src/main/fc/rc.c, over the rate at full stick",
    hooks={"command": on_rate_sticks(_curve)},
    search=Search(shapes=ActualRates._fields[3:], follows_sticks=True, is_setting=True),
)
