"""An accelerometer that shows a force where there is none: its offset at this temperature."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, Range, Search, shifted
from flytrack_env.quaternion import Scalar


class AccelerometerBias(NamedTuple):
    """What the accelerometer adds along body x, y, z, m/s^2."""

    x: Scalar = 0.0
    y: Scalar = 0.0
    z: Scalar = 0.0


ACCELEROMETER_BIAS = Effect(
    name="accelerometer_bias",
    parameters=AccelerometerBias,
    ranges={axis: Range(-2.0, 2.0, "m/s^2") for axis in AccelerometerBias._fields},
    notable={"x": 0.3, "y": 0.3, "z": 0.3},
    equation=r"\mathbf{f}_\text{measured} = \mathbf{f} + (x, y, z)^\top",
    source="assumption: constant within a flight",
    hooks={"accelerometer": shifted},
    search=Search(needs=("f",)),
)
