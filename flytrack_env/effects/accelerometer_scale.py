"""An accelerometer that shows too much or too little: the sensitivity of each of its axes."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, Range, Search, scaled
from flytrack_env.quaternion import Scalar


class AccelerometerScale(NamedTuple):
    """Factor on what the accelerometer shows along body x, y, z, 1."""

    x: Scalar = 1.0
    y: Scalar = 1.0
    z: Scalar = 1.0


ACCELEROMETER_SCALE = Effect(
    name="accelerometer_scale",
    parameters=AccelerometerScale,
    ranges={axis: Range(0.8, 1.2, "1") for axis in AccelerometerScale._fields},
    notable={"x": 0.05, "y": 0.05, "z": 0.05},
    equation=r"\mathbf{f}_\text{measured} = \operatorname{diag}(x, y, z)\, \mathbf{f}",
    source="assumption: linear up to the largest force, no leak between the axes",
    hooks={"accelerometer": scaled},
    search=Search(needs=("f",)),
)
