"""Betaflight's Quick rates: a slope about the centre of each stick that grows towards its end."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, Range, Search, on_rate_sticks
from flytrack_env.quaternion import Scalar


class QuickRates(NamedTuple):
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
    late = expo * size**3 + (1.0 - expo) * size
    return stick * ((1.0 - bend) / (1.0 - bend * late))


QUICK_RATES = Effect(
    name="quick_rates",
    parameters=QuickRates,
    ranges={name: Range(0.0, 0.99, "1") for name in QuickRates._fields},
    notable=dict.fromkeys(QuickRates._fields[:3], 0.05),
    equation=r"u_i \leftarrow u_i \frac{1 - b_i}{1 - b_i "
    r"\left( e_i |u_i|^3 + (1 - e_i) |u_i| \right)}",
    source="applyQuickRates in Betaflight 4.6, src/main/fc/rc.c, over the rate at full stick",
    hooks={"command": on_rate_sticks(_curve)},
    search=Search(shapes=QuickRates._fields[3:], follows_sticks=True, is_setting=True),
)
