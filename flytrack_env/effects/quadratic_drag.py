"""Drag that grows with the square of airspeed: the body's, at racing speeds."""

from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.effects.base import Effect, ForceContext, Range, Search
from flytrack_env.quaternion import Scalar, Vec3


class QuadraticDrag(NamedTuple):
    """Deceleration per airspeed squared along body x, y, z, 1/m.

    Attributes:
        shared: how far the axes share the speed, 1.
    """

    k_x: Scalar = 0.0
    k_y: Scalar = 0.0
    k_z: Scalar = 0.0
    shared: Scalar = 1.0


def _force(drag: QuadraticDrag, memory: None, force_b: Vec3, context: ForceContext) -> Vec3:
    airspeed_b = context.airspeed_b
    shared_speed = drag.shared * airspeed_b.norm()
    axis_share = 1.0 - drag.shared
    coefficients = zip((drag.k_x, drag.k_y, drag.k_z), airspeed_b, strict=True)
    return force_b - Vec3(
        *(k * (shared_speed + axis_share * jnp.abs(speed)) * speed for k, speed in coefficients)
    )


QUADRATIC_DRAG = Effect(
    name="quadratic_drag",
    parameters=QuadraticDrag,
    ranges={
        **{axis: Range(-0.5, 0.5, "1/m") for axis in ("k_x", "k_y", "k_z")},
        "shared": Range(0.0, 1.0, "1"),
    },
    notable={"k_x": 0.005, "k_y": 0.005, "k_z": 0.005},
    equation=r"f_i \leftarrow f_i - k_i \left( s \lVert \mathbf{v}_b \rVert "
    r"+ (1 - s) |v_{b,i}| \right) v_{b,i}, \quad "
    r"\mathbf{v}_b = R^\top (\mathbf{v} - \mathbf{v}_\text{air}), \quad s = \text{shared}",
    source="the drag equation, f = c_d A rho v^2 / 2m: of one body (shared 1), "
    "or of each axis by itself (0)",
    hooks={"force": _force},
    search=Search(needs=("v", "q"), shapes=("shared",)),
)
