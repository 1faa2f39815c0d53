"""A gyro that shows a turn where there is none: its offset since it was last at rest."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, Range, Search, shifted
from flytrack_env.quaternion import Scalar


class GyroBias(NamedTuple):
    """What the gyro adds about body x, y, z, rad/s."""

    x: Scalar = 0.0
    y: Scalar = 0.0
    z: Scalar = 0.0


GYRO_BIAS = Effect(
    name="gyro_bias",
    parameters=GyroBias,
    ranges={axis: Range(-0.5, 0.5, "rad/s") for axis in GyroBias._fields},
    notable={"x": 0.02, "y": 0.02, "z": 0.02},
    equation=r"\boldsymbol{\omega}_\text{measured} = \boldsymbol{\omega} + (x, y, z)^\top",
    source="assumption: constant within a flight; the rate loop flies by the true rates",
    hooks={"gyro": shifted},
    search=Search(needs=("w",)),
)
