"""An accelerometer away from the centre of mass, which turns show a force."""

from typing import NamedTuple

from flytrack_env.effects.base import AccelerometerContext, Effect, Range, Search
from flytrack_env.quaternion import Scalar, Vec3


class ImuOffset(NamedTuple):
    """Where the accelerometer is, from the centre of mass along body x, y, z, m."""

    x: Scalar = 0.0
    y: Scalar = 0.0
    z: Scalar = 0.0


def _accelerometer(
    offset: ImuOffset, memory: None, force_b: Vec3, context: AccelerometerContext
) -> Vec3:
    arm_b, rates_b = Vec3(*offset), context.rates_b
    turning_b = context.angular_acc_b.cross(arm_b)
    return force_b + (rates_b.cross(rates_b.cross(arm_b)) + turning_b)


IMU_OFFSET = Effect(
    name="imu_offset",
    parameters=ImuOffset,
    ranges={axis: Range(-0.2, 0.2, "m") for axis in ImuOffset._fields},
    notable={"x": 0.02, "y": 0.02, "z": 0.02},
    equation=r"\mathbf{f}_\text{measured} = \mathbf{f} + \boldsymbol{\omega} \times "
    r"(\boldsymbol{\omega} \times \mathbf{r}) + \dot{\boldsymbol{\omega}} \times \mathbf{r}",
    source="acceleration of a point of a rigid body; "
    "assumption: rates change evenly within the step",
    hooks={"accelerometer": _accelerometer},
    search=Search(needs=("f",)),
)
