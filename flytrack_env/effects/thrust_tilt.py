"""A thrust axis that is not body z: bent arms, or a flight controller mounted askew."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, ForceContext, Range
from flytrack_env.quaternion import Scalar, Vec3


class ThrustTilt(NamedTuple):
    """Angles by which the thrust leans towards body x and body y, rad."""

    towards_x: Scalar = 0.0
    towards_y: Scalar = 0.0


def _force(tilt: ThrustTilt, memory: None, force_b: Vec3, context: ForceContext) -> Vec3:
    thrust = context.thrust_acc
    return Vec3(force_b.x + tilt.towards_x * thrust, force_b.y + tilt.towards_y * thrust, force_b.z)


THRUST_TILT = Effect(
    name="thrust_tilt",
    parameters=ThrustTilt,
    ranges={name: Range(-0.2, 0.2, "rad") for name in ThrustTilt._fields},
    notable={"towards_x": 0.01, "towards_y": 0.01},
    equation=r"\mathbf{f}_b \leftarrow \mathbf{f}_b + \frac{T}{m} "
    r"(\text{towards}_x, \text{towards}_y, 0)^\top",
    source="assumption: small angles, the same at any thrust",
    hooks={"force": _force},
)
