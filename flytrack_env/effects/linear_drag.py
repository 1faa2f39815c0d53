"""Drag that grows with airspeed, per body axis: what rotors do to a racing drone first of all."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, ForceContext, Range, Search
from flytrack_env.quaternion import Scalar, Vec3


class LinearDrag(NamedTuple):
    """Deceleration per airspeed along body x, y, z, 1/s."""

    d_x: Scalar = 0.0
    d_y: Scalar = 0.0
    d_z: Scalar = 0.0


def _force(drag: LinearDrag, memory: None, force_b: Vec3, context: ForceContext) -> Vec3:
    airspeed_b = context.airspeed_b
    return force_b - Vec3(drag.d_x * airspeed_b.x, drag.d_y * airspeed_b.y, drag.d_z * airspeed_b.z)


LINEAR_DRAG = Effect(
    name="linear_drag",
    parameters=LinearDrag,
    ranges={axis: Range(-3.0, 3.0, "1/s") for axis in LinearDrag._fields},
    notable={"d_x": 0.05, "d_y": 0.05, "d_z": 0.05},
    equation=r"\mathbf{f}_b \leftarrow \mathbf{f}_b - \operatorname{diag}(d_x, d_y, d_z)\, R^\top "
    r"(\mathbf{v} - \mathbf{v}_\text{air})",
    source='M. Faessler et al., "Differential flatness of quadrotor dynamics subject to rotor '
    'drag", eq. 2',
    hooks={"force": _force},
    search=Search(needs=("v", "q")),
)
