"""What gyro and accelerometer show wrongly: offsets, sensitivities, a place off the centre of mass."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, Range, StepContext, scaled, shifted
from flytrack_env.motion import Motion
from flytrack_env.quaternion import Scalar, Vec3


class Offsets(NamedTuple):
    """What is added along x, y and z."""

    x: Scalar = 0.0
    y: Scalar = 0.0
    z: Scalar = 0.0


class Factors(NamedTuple):
    """What x, y and z are multiplied by."""

    x: Scalar = 1.0
    y: Scalar = 1.0
    z: Scalar = 1.0


class ImuOffset(Offsets):
    """Where the accelerometer is, from the centre of mass along body x, y, z, m."""


def _off_centre(offset: ImuOffset, memory: None, force_b: Vec3, context: StepContext) -> Vec3:
    """Return the reading with the rates at the end of a continuous step, else with the mean ones.

    The change of rates from one step to the next is centred there.
    """
    arm_b, before = Vec3(*offset), context.drone.rates_b
    if context.motion is Motion.CONTINUOUS:
        rates_b, angular_acc_b = context.rates_b, context.angular_acc_b
    else:
        rates_b = (before + context.rates_b).scale(0.5)
        angular_acc_b = (context.rates_b - before).scale(1.0 / context.dt)
    return force_b + (rates_b.cross(rates_b.cross(arm_b)) + angular_acc_b.cross(arm_b))


IMU_OFFSET = Effect(
    parameters=ImuOffset,
    about="An accelerometer away from the centre of mass, which turns show a force.",
    ranges={axis: Range(-0.2, 0.2, "m") for axis in ImuOffset._fields},
    notable={"x": 0.02, "y": 0.02, "z": 0.02},
    needs=("f",),
    equation=r"\mathbf{f}_\text{measured} = \mathbf{f} + \boldsymbol{\omega} \times (\boldsymbol{\omega} "
    r"\times \mathbf{r}) + \dot{\boldsymbol{\omega}} \times \mathbf{r}",
    source="acceleration of a point of a rigid body; assumption: rates change evenly within the step",
    accelerometer=_off_centre,
)


class AccelerometerScale(Factors):
    """Factor on what the accelerometer shows along body x, y, z, 1."""


ACCELEROMETER_SCALE = Effect(
    parameters=AccelerometerScale,
    about="An accelerometer that shows too much or too little: the sensitivity of each of its axes.",
    ranges={axis: Range(0.8, 1.2, "1") for axis in AccelerometerScale._fields},
    notable={"x": 0.05, "y": 0.05, "z": 0.05},
    needs=("f",),
    equation=r"\mathbf{f}_\text{measured} = \operatorname{diag}(x, y, z)\, \mathbf{f}",
    source="assumption: linear up to the largest force, no leak between the axes",
    accelerometer=scaled,
)


class AccelerometerBias(Offsets):
    """What the accelerometer adds along body x, y, z, m/s^2."""


ACCELEROMETER_BIAS = Effect(
    parameters=AccelerometerBias,
    about="An accelerometer that shows a force where there is none: its offset at this temperature.",
    ranges={axis: Range(-2.0, 2.0, "m/s^2") for axis in AccelerometerBias._fields},
    notable={"x": 0.3, "y": 0.3, "z": 0.3},
    needs=("f",),
    equation=r"\mathbf{f}_\text{measured} = \mathbf{f} + (x, y, z)^\top",
    source="assumption: constant within a flight",
    accelerometer=shifted,
)


class GyroScale(Factors):
    """Factor on what the gyro shows about body x, y, z, 1."""


GYRO_SCALE = Effect(
    parameters=GyroScale,
    about="A gyro that shows too fast or too slow a turn: the sensitivity of each of its axes.",
    ranges={axis: Range(0.8, 1.2, "1") for axis in GyroScale._fields},
    notable={"x": 0.02, "y": 0.02, "z": 0.02},
    follows_sticks=True,
    needs=("w",),
    equation=r"\boldsymbol{\omega}_\text{measured} = \operatorname{diag}(x, y, z)\, \boldsymbol{\omega}",
    source="assumption: linear up to the fastest turn, no leak between the axes",
    gyro=scaled,
)


class GyroBias(Offsets):
    """What the gyro adds about body x, y, z, rad/s."""


GYRO_BIAS = Effect(
    parameters=GyroBias,
    about="A gyro that shows a turn where there is none: its offset since it was last at rest.",
    ranges={axis: Range(-0.5, 0.5, "rad/s") for axis in GyroBias._fields},
    notable={"x": 0.02, "y": 0.02, "z": 0.02},
    needs=("w",),
    equation=r"\boldsymbol{\omega}_\text{measured} = \boldsymbol{\omega} + (x, y, z)^\top",
    source="assumption: constant within a flight; the rate loop flies by the true rates",
    gyro=shifted,
)
