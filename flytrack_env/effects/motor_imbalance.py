"""Roll and pitch that creep with thrust: unequal motors, or a centre of mass off the middle."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, Range, RatesContext
from flytrack_env.quaternion import Scalar, Vec3


class MotorImbalance(NamedTuple):
    """Roll and pitch rate per collective thrust over mass, (rad/s)/(m/s^2)."""

    roll: Scalar = 0.0
    pitch: Scalar = 0.0


def _rates(imbalance: MotorImbalance, memory: None, rates_b: Vec3, context: RatesContext) -> Vec3:
    thrust_acc = context.force.thrust_acc
    return Vec3(
        rates_b.x + imbalance.roll * thrust_acc, rates_b.y + imbalance.pitch * thrust_acc, rates_b.z
    )


MOTOR_IMBALANCE = Effect(
    name="motor_imbalance",
    parameters=MotorImbalance,
    ranges={axis: Range(-0.05, 0.05, "(rad/s)/(m/s^2)") for axis in MotorImbalance._fields},
    notable={"roll": 0.002, "pitch": 0.002},
    equation=r"\omega_x \leftarrow \omega_x + \text{roll}\, \frac{T}{m}, \quad "
    r"\omega_y \leftarrow \omega_y + \text{pitch}\, \frac{T}{m}",
    source="assumption: a torque in proportion to thrust, "
    "which a rate loop without integral part leaves",
    hooks={"rates": _rates},
)
