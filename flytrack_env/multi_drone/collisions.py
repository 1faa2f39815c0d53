"""Collisions of drones as spheres, swept over a step, so that none passes between two steps."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.fusion import compute_once
from flytrack_env.multi_drone.rules import BOTH_OUT, RaceRules
from flytrack_env.quaternion import Vec3


class Path(NamedTuple):
    """A drone's way through one step, straight and at constant speed; points in m, world."""

    start_w: Vec3
    end_w: Vec3

    def move(self) -> Vec3:
        """Return the way from start to end."""
        return self.end_w - self.start_w


def is_put_out(own: Path, other: Path, rules: RaceRules) -> jax.Array:
    """Return whether a collision in this step puts a drone out of the race, a bool scalar.

    The spheres touch where the distance of the two, both moving evenly, falls below a diameter at
    any moment of the step. Who approached the other the faster at that moment, along the line
    between the two, ran into it; who approached equally fast, did too.
    """
    apart = compute_once(other.start_w - own.start_w)
    own_move, other_move = own.move(), other.move()
    drift = compute_once(other_move - own_move)
    squared = drift.dot(drift)
    is_drifting = squared > 0.0
    when = jnp.where(is_drifting, -apart.dot(drift) / jnp.where(is_drifting, squared, 1.0), 0.0)
    nearest = compute_once(apart + drift.scale(jnp.clip(when, 0.0, 1.0)))
    diameter = 2.0 * rules.collision_radius
    is_touching = nearest.dot(nearest) < diameter * diameter
    has_rammed = nearest.dot(own_move) >= -nearest.dot(other_move)
    return jnp.asarray(is_touching & (has_rammed | (jnp.asarray(rules.blame) == BOTH_OUT)))
