"""The wake of a drone, and how it pushes down whoever flies into it.

A rotor's thrust is the momentum of the air that it throws down. That air is taken for a round turbulent jet:
its momentum stays, while it widens and slows down (Pope, Turbulent Flows, 2000, section 5.1). A drone in it
takes the share of the momentum that meets its disc, and no more than all of it. The jet leaves against the
thrust axis, and in forward flight it stays behind, as the air in it does not move on with the drone.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from flytrack_env.fusion import compute_once
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.state import Drone

DISC_RADIUS_M = 0.15
SPREAD = 0.08  # m of radius gained by a metre of way: a half-width that grows by 0.1, as in Pope's figure 5.6
AIR_DENSITY = 1.2  # kg/m^3
MASS_KG = 1.0  # of the nominal drone; it decides only how far the jet stays behind
DISC_AREA = np.pi * DISC_RADIUS_M**2
SMALL = 1e-6


class Wake(NamedTuple):
    """What a drone leaves behind.

    pos_w: where it begins, m. push_w: thrust's reaction on the air, m/s^2: its acceleration by thrust,
    downwards. air_w: velocity of that air against the drone, m/s.
    """

    pos_w: Vec3
    push_w: Vec3
    air_w: Vec3


def wake_of(drone: Drone, gravity: Scalar, is_flying: Scalar) -> Wake:
    """Return the wake of a drone, of no strength unless it is flying. gravity: m/s^2."""
    _, _, up = drone.quat.axes()
    thrust = drone.acc_w.dot(up) + gravity * up.z
    thrust = compute_once(jnp.where(is_flying, jnp.maximum(thrust, 0.0), 0.0))
    # Momentum theory: far below, air has twice the speed that it has in the disc.
    speed = jnp.sqrt(2.0 * MASS_KG * thrust / (AIR_DENSITY * DISC_AREA) + SMALL)
    return Wake(drone.pos_w, up.scale(-thrust), up.scale(-speed) - drone.vel_w)


def downwash_acc_w(pos_w: Vec3, wake: Wake) -> Vec3:
    """Return how the wake of another drone of the same mass and disc accelerates one, world, m/s^2."""
    axis = compute_once(wake.air_w.scale(1.0 / (wake.air_w.norm() + SMALL)))
    apart = pos_w - wake.pos_w
    along = compute_once(apart.dot(axis))
    across = apart - axis.scale(along)
    radius = DISC_RADIUS_M + SPREAD * jnp.maximum(along, 0.0)
    met = 1.0 - jnp.exp(-((DISC_RADIUS_M / radius) ** 2))
    within = jnp.exp(-across.dot(across) / (radius * radius))
    strength = jnp.where(along > 0.0, met * within, 0.0)
    return wake.push_w.scale(compute_once(strength))


def pushed(drone: Drone, acc_w: Vec3, dt: Scalar) -> Drone:
    """Return a drone after a step in which it was also accelerated, world, m/s^2.

    Its position follows in the next step.
    """
    return drone._replace(vel_w=drone.vel_w + acc_w.scale(dt), acc_w=drone.acc_w + acc_w)
