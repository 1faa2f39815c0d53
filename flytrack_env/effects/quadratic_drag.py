"""Drag that grows with the square of airspeed: the body's, at racing speeds."""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, Flight, Range
from flytrack_env.quaternion import Scalar, Vec3


class QuadraticDrag(NamedTuple):
    """Deceleration per airspeed times speed along body x, y, z, 1/m."""

    k_x: Scalar = 0.0
    k_y: Scalar = 0.0
    k_z: Scalar = 0.0


def _force(drag: QuadraticDrag, memory: None, force_b: Vec3, flight: Flight) -> Vec3:
    airspeed_b = flight.airspeed_b()
    speed = airspeed_b.norm()
    return force_b - Vec3(
        drag.k_x * speed * airspeed_b.x,
        drag.k_y * speed * airspeed_b.y,
        drag.k_z * speed * airspeed_b.z,
    )


QUADRATIC_DRAG = Effect(
    name="quadratic_drag",
    parameters=QuadraticDrag,
    ranges={axis: Range(-0.5, 0.5, "1/m") for axis in QuadraticDrag._fields},
    equation="f_b -= diag(k) |v - v_air| R^T (v - v_air)",
    source="the drag equation, f = c_d A rho v^2 / 2m along each axis, k = c_d A rho / 2m",
    force=_force,
)
