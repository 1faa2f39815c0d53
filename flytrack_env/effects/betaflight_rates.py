"""Betaflight's own rates: sticks that turn faster towards their ends, and a centre expo."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, Range, Search, on_rate_sticks
from flytrack_env.quaternion import Scalar


class BetaflightRates(NamedTuple):
    """Super rate of each stick, 1; its expo, 1."""

    roll: Scalar = 0.0
    pitch: Scalar = 0.0
    yaw: Scalar = 0.0
    roll_expo: Scalar = 0.0
    pitch_expo: Scalar = 0.0
    yaw_expo: Scalar = 0.0


def _curve(stick: Scalar, super_rate: Scalar, expo: Scalar) -> Scalar:
    size = jnp.abs(stick)
    curved = 1.0 - expo + expo * size**3
    return stick * (curved * ((1.0 - super_rate) / (1.0 - super_rate * size)))


BETAFLIGHT_RATES = Effect(
    name="betaflight_rates",
    parameters=BetaflightRates,
    ranges={name: Range(0.0, 0.99, "1") for name in BetaflightRates._fields},
    notable=dict.fromkeys(BetaflightRates._fields, 0.05),
    equation=r"u_i \leftarrow u_i \left( 1 - e_i + e_i |u_i|^3 \right) "
    r"\frac{1 - s_i}{1 - s_i |u_i|}",
    source="applyBetaflightRates in Betaflight 4.6, src/main/fc/rc.c, over the rate at full stick",
    hooks={"command": on_rate_sticks(_curve)},
    search=Search(follows_sticks=True, is_setting=True),
)
