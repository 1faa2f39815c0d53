"""Steady wind: moving air where the model has drag, and a constant push that needs no drag.

A log in which no drag was identified shows the push only; one with drag shows the velocity. The
parameters are apart because their units are.
"""

from typing import NamedTuple

from flytrack_env.effects.base import Effect, ForceContext, Range, Search
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.state import Drone


class Wind(NamedTuple):
    """Velocity of the air, v_*, m/s, and constant specific force, a_*, m/s^2; world frame."""

    v_x: Scalar = 0.0
    v_y: Scalar = 0.0
    v_z: Scalar = 0.0
    a_x: Scalar = 0.0
    a_y: Scalar = 0.0
    a_z: Scalar = 0.0


def _air(wind: Wind, memory: None, air_w: Vec3, drone: Drone) -> Vec3:
    return air_w + Vec3(wind.v_x, wind.v_y, wind.v_z)


def _force(wind: Wind, memory: None, force_b: Vec3, context: ForceContext) -> Vec3:
    push_w = Vec3(wind.a_x, wind.a_y, wind.a_z)
    return force_b + Vec3(*(axis.dot(push_w) for axis in context.body_axes_w))


WIND = Effect(
    name="wind",
    parameters=Wind,
    ranges={
        **{name: Range(-20.0, 20.0, "m/s") for name in ("v_x", "v_y", "v_z")},
        **{name: Range(-5.0, 5.0, "m/s^2") for name in ("a_x", "a_y", "a_z")},
    },
    notable={"a_x": 0.2, "a_y": 0.2, "a_z": 0.2, "v_x": 1.0, "v_y": 1.0, "v_z": 1.0},
    equation=r"\mathbf{v}_\text{air} \leftarrow \mathbf{v}_\text{air} + \mathbf{v}, \quad "
    r"\mathbf{f}_b \leftarrow \mathbf{f}_b + R^\top \mathbf{a}",
    source="assumption: uniform and steady within a flight",
    hooks={"air": _air, "force": _force},
    search=Search(needs=("q",), groups=(("a_x", "a_y", "a_z"), ("v_x", "v_y", "v_z"))),
)
