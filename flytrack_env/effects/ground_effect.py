"""Thrust gained near the ground, which the rotors' wake cannot pass."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, ForceContext, Range, Search
from flytrack_env.quaternion import Scalar


class GroundEffect(NamedTuple):
    """Share of the thrust gained on the ground, 1, and the height at which half of it is left, m.

    Of one rotor the gain is about 1/16 and the height its radius; a whole quadcopter gains more.
    """

    gain: Scalar = 0.0
    height_m: Scalar = 0.3


def _thrust(ground: GroundEffect, memory: None, thrust_n: Scalar, context: ForceContext) -> Scalar:
    heights = jnp.maximum(context.drone.pos_w.z, 0.0) / ground.height_m
    return thrust_n * (1.0 + ground.gain / (1.0 + heights * heights))


GROUND_EFFECT = Effect(
    name="ground_effect",
    parameters=GroundEffect,
    ranges={"gain": Range(-0.5, 0.5, "1"), "height_m": Range(0.05, 2.0, "m")},
    notable={"gain": 0.05},
    equation=r"T \leftarrow T \left( 1 + \frac{\text{gain}}{1 + (z / \text{height})^2} \right)",
    source="I. C. Cheeseman, W. E. Bennett, ARC R&M 3021, 1955, to first order in "
    "(radius / 4 z)^2 = gain (height_m / z)^2, levelled off",
    hooks={"thrust": _thrust},
    search=Search(needs=("p",), shapes=("height_m",)),
)
