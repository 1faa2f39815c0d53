"""Thrust gained near the ground, which the rotors' wake cannot pass."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, Flight, Range
from flytrack_env.quaternion import Scalar

# (radius / 4)^2 times this is the radius squared: below one radius the gain levels off.
RADII = 16.0
# m^2, keeps 0 / 0 away where there is no effect and no height; far below any rotor's.
TINY_AREA = 1e-12


class GroundEffect(NamedTuple):
    """Area, m^2: the square of a quarter of the radius of one rotor that stands for all four."""

    area: Scalar = 0.0


def _thrust(ground: GroundEffect, memory: None, thrust_n: Scalar, flight: Flight) -> Scalar:
    height = jnp.maximum(flight.drone.pos_w.z, 0.0)
    near = ground.area / (height * height + RADII * jnp.abs(ground.area) + TINY_AREA)
    return thrust_n * (1.0 + near)


GROUND_EFFECT = Effect(
    name="ground_effect",
    parameters=GroundEffect,
    ranges={"area": Range(-0.01, 0.01, "m^2")},
    notable={"area": 0.001},
    needs=("p",),
    equation="T *= 1 + area / (z^2 + 16 area)",
    source="I. C. Cheeseman, W. E. Bennett, ARC R&M 3021, 1955, to first order in area / z^2, levelled off",
    thrust=_thrust,
)
