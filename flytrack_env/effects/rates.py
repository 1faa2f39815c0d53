"""Body rates that are not those of the lagged sticks: other settings, and torques that the loop leaves."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, Range, StepContext, scaled
from flytrack_env.motion import Motion
from flytrack_env.quaternion import Scalar, Vec3


class RateScale(NamedTuple):
    """Factor on the body rates about x, y, z, 1."""

    roll: Scalar = 1.0
    pitch: Scalar = 1.0
    yaw: Scalar = 1.0


RATE_SCALE = Effect(
    parameters=RateScale,
    about="Other maximum body rates than the model's: a wrong setting of the flight controller.",
    ranges={axis: Range(0.5, 1.5, "1") for axis in RateScale._fields},
    notable={"roll": 0.03, "pitch": 0.03, "yaw": 0.03},
    follows_sticks=True,
    equation=r"\boldsymbol{\omega} \leftarrow \operatorname{diag}(\text{roll}, \text{pitch}, \text{yaw})\, "
    r"\boldsymbol{\omega}",
    source="assumption: the stick's curve stays linear",
    rates=scaled,
)


class YawReaction(NamedTuple):
    """Yaw angle by which a change of the applied thrust action by 1 turns the drone, rad."""

    angle: Scalar = 0.0


def _reaction(reaction: YawReaction, memory: None, rates_b: Vec3, context: StepContext) -> Vec3:
    if context.motion is Motion.CONTINUOUS:
        change = context.applied_slope.thrust
    else:
        change = (context.applied.thrust - context.drone.applied.thrust) / context.dt
    return rates_b._replace(z=rates_b.z + reaction.angle * change)


YAW_REACTION = Effect(
    parameters=YawReaction,
    about="A yaw rate that is kicked when the thrust changes: propellers that spin up turn the frame "
    "the other way.",
    ranges={"angle": Range(-0.2, 0.2, "rad")},
    notable={"angle": 0.02},
    equation=r"\omega_z \leftarrow \omega_z + \text{angle}\, \frac{du}{dt}",
    source="assumption: unequal spin-up of the two directions of rotation, in proportion to its speed",
    rates=_reaction,
)


class MotorImbalance(NamedTuple):
    """Roll and pitch rate per collective thrust over mass, (rad/s)/(m/s^2)."""

    roll: Scalar = 0.0
    pitch: Scalar = 0.0


def _imbalance(imbalance: MotorImbalance, memory: None, rates_b: Vec3, context: StepContext) -> Vec3:
    thrust_acc = context.thrust_acc
    return Vec3(rates_b.x + imbalance.roll * thrust_acc, rates_b.y + imbalance.pitch * thrust_acc, rates_b.z)


MOTOR_IMBALANCE = Effect(
    parameters=MotorImbalance,
    about="Roll and pitch that creep with thrust: unequal motors, or a centre of mass off the middle.",
    ranges={axis: Range(-0.05, 0.05, "(rad/s)/(m/s^2)") for axis in MotorImbalance._fields},
    notable={"roll": 0.002, "pitch": 0.002},
    equation=r"\omega_x \leftarrow \omega_x + \text{roll}\, \frac{T}{m}, \quad \omega_y \leftarrow \omega_y "
    r"+ \text{pitch}\, \frac{T}{m}",
    source="assumption: a torque in proportion to thrust, which a rate loop without integral part leaves",
    rates=_imbalance,
)


class RateCrossCoupling(NamedTuple):
    """Shares of the roll and of the pitch rate that leak into the yaw rate, 1."""

    from_roll: Scalar = 0.0
    from_pitch: Scalar = 0.0


def _coupling(coupling: RateCrossCoupling, memory: None, rates_b: Vec3, context: StepContext) -> Vec3:
    leak = coupling.from_roll * rates_b.x + coupling.from_pitch * rates_b.y
    return rates_b._replace(z=rates_b.z + leak)


RATE_CROSS_COUPLING = Effect(
    parameters=RateCrossCoupling,
    about="Yaw that turns with roll and pitch: a gyro or a frame that is not square, or unequal propellers.",
    ranges={axis: Range(-0.3, 0.3, "1") for axis in RateCrossCoupling._fields},
    notable={"from_roll": 0.03, "from_pitch": 0.03},
    follows_sticks=True,
    equation=r"\omega_z \leftarrow \omega_z + \text{from roll} \cdot \omega_x + \text{from pitch} \cdot "
    r"\omega_y",
    source="assumption: in proportion, and into yaw only, the axis with the least authority",
    rates=_coupling,
)
