"""Other maximum body rates than the model's: a wrong setting of the flight controller."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, Range, Search, scaled
from flytrack_env.quaternion import Scalar


class RateScale(NamedTuple):
    """Factor on the body rates about x, y, z, 1."""

    roll: Scalar = 1.0
    pitch: Scalar = 1.0
    yaw: Scalar = 1.0


RATE_SCALE = Effect(
    name="rate_scale",
    parameters=RateScale,
    ranges={axis: Range(0.5, 1.5, "1") for axis in RateScale._fields},
    notable={"roll": 0.03, "pitch": 0.03, "yaw": 0.03},
    equation=r"\boldsymbol{\omega} \leftarrow "
    r"\operatorname{diag}(\text{roll}, \text{pitch}, \text{yaw})\, \boldsymbol{\omega}",
    source="assumption: the stick's curve stays linear",
    hooks={"rates": scaled},
    search=Search(follows_sticks=True),
)
