"""The start grid: slots left and right of a line, each a row behind the one before."""

import jax.numpy as jnp

from flytrack_env.fusion import compute_once
from flytrack_env.multi_drone.rules import RaceRules
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.state import Drone


def place_on_grid(drone: Drone, slot: Scalar, rules: RaceRules) -> Drone:
    """Return a drone moved from the head of the grid to a slot of it, an int32 scalar.

    Slot 0 is half a column left of the head, slot 1 half a column right and a row behind, and so
    on. Rows and columns are along and across the level direction that the drone faces.
    """
    ahead, _, _ = drone.quat.axes()
    level = Vec3(ahead.x, ahead.y, 0.0)
    forward = compute_once(level.scale(1.0 / (level.norm() + 1e-6)))
    left = Vec3(-forward.y, forward.x, 0.0)
    row, column = (jnp.asarray(index).astype(jnp.float32) for index in (slot, slot % 2))
    offset = left.scale((0.5 - column) * rules.column_spacing) - forward.scale(
        row * rules.row_spacing
    )
    return drone._replace(pos_w=compute_once(drone.pos_w + offset))
