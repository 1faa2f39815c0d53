"""The wake of a drone, and how it pushes down whoever flies into it.

A drone's thrust is the momentum of the air that it throws down. Far below, that air is a round turbulent jet,
which keeps its momentum while it widens and slows down: Pope, Turbulent Flows, 2000, section 5.1, and,
measured below hovering quadrotors from 2.5 of their diameters on, Bauersfeld et al., Robotics meets Fluid
Dynamics, 2024 (arXiv 2403.13321). A drone in it is taken for a plate that stops all the air that meets it,
which is the most that it can feel. In forward flight the jet stays behind, since its air does not move on
with the drone.

Not modelled: that air needs time to get there, so that a wake bends when its drone turns; torques; the field
near the drone; that wakes mix. Those of several drones add up.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from flytrack_env.fusion import compute_once
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.state import Drone

DISC_RADIUS_M = 0.15
DISC_AREA_M2 = np.pi * DISC_RADIUS_M**2
# Growth of the radius per metre. Pope's table 5.1 has 0.094 for the half-width of velocity, which is
# sqrt(2 ln 2) radii where momentum falls off as exp(-(r / radius)^2).
SPREAD = 0.08
AIR_DENSITY = 1.2  # kg/m^3
MASS_KG = 1.0  # of the nominal drone; it decides only how far the jet stays behind
SMALL = 1e-6


class Wake(NamedTuple):
    """What a drone leaves behind.

    pos_w: where it begins, m. push_w: the drone's acceleration by thrust, reversed, m/s^2. air_w: velocity of
    the air relative to the drone, m/s.
    """

    pos_w: Vec3
    push_w: Vec3
    air_w: Vec3


def wake_of(drone: Drone, gravity: Scalar, is_flying: Scalar) -> Wake:
    """Return the wake of a drone, zero unless it flies.

    gravity: m/s^2. Thrust is taken to be all of the specific force along the thrust axis. The air's speed is
    that of momentum theory for a disc that moves edgewise (Glauert), twice the induced velocity.
    """
    _, _, up = drone.quat.axes()
    thrust = drone.acc_w.dot(up) + gravity * up.z
    thrust = compute_once(jnp.where(is_flying, jnp.maximum(thrust, 0.0), 0.0))
    hover = MASS_KG * thrust / (2.0 * AIR_DENSITY * DISC_AREA_M2)  # induced velocity in hover, squared
    half = 0.5 * drone.vel_w.dot(drone.vel_w)
    induced = jnp.sqrt(hover * hover / (half + jnp.sqrt(half * half + hover * hover) + SMALL) + SMALL)
    return Wake(drone.pos_w, up.scale(-thrust), up.scale(-2.0 * induced) - drone.vel_w)


def downwash_acc_w(pos_w: Vec3, wake: Wake) -> Vec3:
    """Return how a wake accelerates another drone at ``pos_w`` of the same mass and disc, world, m/s^2."""
    axis = compute_once(wake.air_w.scale(1.0 / (wake.air_w.norm() + SMALL)))
    apart = pos_w - wake.pos_w
    along = compute_once(apart.dot(axis))
    across = apart - axis.scale(along)
    radius = DISC_RADIUS_M + SPREAD * jnp.maximum(along, 0.0)
    share_in_middle = 1.0 - jnp.exp(-((DISC_RADIUS_M / radius) ** 2))
    falloff = jnp.exp(-across.dot(across) / (radius * radius))
    strength = jnp.where(along > 0.0, share_in_middle * falloff, 0.0)
    return wake.push_w.scale(compute_once(strength))


def push(drone: Drone, acc_w: Vec3, dt: Scalar) -> Drone:
    """Return a drone after a step in which it was accelerated in addition, world, m/s^2.

    Its position follows in the next step.
    """
    return drone._replace(vel_w=drone.vel_w + acc_w.scale(dt), acc_w=drone.acc_w + acc_w)
