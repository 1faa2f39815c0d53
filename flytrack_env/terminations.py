"""Why an episode terminates. The time limit is not here: that is truncation."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.battery import Battery
from flytrack_env.state import Drone
from flytrack_env.tracks import Course


class Causes(NamedTuple):
    """Causes of termination, each a bool; several can hold at once.

    Attributes:
        crash: the drone touched a gate's frame, or was given an action that is not a number.
        ground: below the floor of the bounds.
        out_of_bounds: beyond any other side.
        missed_gate: crossed the gate's plane outside its frame.
        battery_empty: below the battery's empty voltage.
    """

    crash: jax.Array
    ground: jax.Array
    out_of_bounds: jax.Array
    missed_gate: jax.Array
    battery_empty: jax.Array

    def any(self) -> jax.Array:
        """Return whether the episode terminates, a bool scalar."""
        return self.crash | self.ground | self.out_of_bounds | self.missed_gate | self.battery_empty


def find_causes(
    drone: Drone, course: Course, battery: Battery, is_crash: jax.Array, is_missed: jax.Array
) -> Causes:
    """Return the causes of termination after a step.

    Args:
        is_crash: from the gate's crossing, bool scalar.
        is_missed: the same.
    """
    pos_w, low, high = drone.pos_w, course.bounds_low, course.bounds_high
    is_below = jnp.asarray(pos_w.z < low.z)
    is_inside = (  # not if a coordinate is NaN
        (pos_w.x >= low.x)
        & (pos_w.x <= high.x)
        & (pos_w.y >= low.y)
        & (pos_w.y <= high.y)
        & (pos_w.z <= high.z)
    )
    return Causes(
        crash=jnp.asarray(is_crash),
        ground=is_below,
        out_of_bounds=~jnp.asarray(is_inside),
        missed_gate=jnp.asarray(is_missed),
        battery_empty=jnp.asarray(drone.battery_v < battery.empty_v),
    )
