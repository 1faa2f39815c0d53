"""Drag in the rotors' plane, in proportion to thrust: flapping blades tilt the thrust back."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, ForceContext, Range, Search
from flytrack_env.quaternion import Scalar, Vec3


class RotorDrag(NamedTuple):
    """Share of the thrust that leans back per airspeed in the rotors' plane, s/m."""

    h: Scalar = 0.0


def _force(drag: RotorDrag, memory: None, force_b: Vec3, context: ForceContext) -> Vec3:
    airspeed_b = context.airspeed_b
    lean = drag.h * context.thrust_acc
    return Vec3(force_b.x - lean * airspeed_b.x, force_b.y - lean * airspeed_b.y, force_b.z)


ROTOR_DRAG = Effect(
    name="rotor_drag",
    parameters=RotorDrag,
    ranges={"h": Range(-0.2, 0.2, "s/m")},
    notable={"h": 0.005},
    equation=r"\mathbf{f}_b \leftarrow \mathbf{f}_b - h\, \frac{T}{m} "
    r"\operatorname{diag}(1, 1, 0)\, R^\top (\mathbf{v} - \mathbf{v}_\text{air})",
    source='R. Mahony, V. Kumar, P. Corke, "Multirotor aerial vehicles", 2012, eq. 12: '
    "blade flapping",
    hooks={"force": _force},
    search=Search(needs=("v", "q")),
)
