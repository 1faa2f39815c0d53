"""A gyro that shows too fast or too slow a turn: the sensitivity of each of its axes."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, Range, Search, scaled
from flytrack_env.quaternion import Scalar


class GyroScale(NamedTuple):
    """Factor on what the gyro shows about body x, y, z, 1."""

    x: Scalar = 1.0
    y: Scalar = 1.0
    z: Scalar = 1.0


GYRO_SCALE = Effect(
    name="gyro_scale",
    parameters=GyroScale,
    ranges={axis: Range(0.8, 1.2, "1") for axis in GyroScale._fields},
    notable={"x": 0.02, "y": 0.02, "z": 0.02},
    equation=r"\boldsymbol{\omega}_\text{measured} = "
    r"\operatorname{diag}(x, y, z)\, \boldsymbol{\omega}",
    source="assumption: linear up to the fastest turn, no leak between the axes",
    hooks={"gyro": scaled},
    search=Search(follows_sticks=True, needs=("w",)),
)
