"""A load on a string below the drone, as a pendulum of small swings that the drone's velocity drives.

What a law of ``flytrack_env.effects.grammar`` remembers of it; how hard the load pulls is the law's.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp

from flytrack_env.quaternion import Scalar, Vec3

GRAVITY = 9.81  # m/s^2, whatever that of the model: only the ratio to the length acts


class Pendulum(NamedTuple):
    """How far a load is off the point below the drone, m, and its velocity, m/s; world, horizontal."""

    off_x: Scalar
    off_y: Scalar
    vel_x: Scalar
    vel_y: Scalar


def is_swinging(length: float, damping: float) -> bool:
    """Return whether a load on a string of this length, m, swings with this damping, 1/s."""
    return length > 0.0 and 0.0 < damping < 2.0 * math.sqrt(GRAVITY / length)


def start_load(vel_w: Vec3) -> Pendulum:
    """Return a load that hangs still below a drone with this velocity, m/s."""
    return Pendulum(0.0 * vel_w.x, 0.0 * vel_w.y, vel_w.x, vel_w.y)


def advance_load(load: Pendulum, vel_w: Vec3, dt: Scalar, length: Scalar, damping: Scalar) -> Pendulum:
    """Return a load a step later: off'' = -acc - damping off' - g / length off, exact for a held velocity.

    vel_w: mean velocity of the drone in the step, m/s. dt: s. length, damping: as for ``is_swinging``.
    """
    stiffness, half = GRAVITY / length, 0.5 * damping
    frequency = jnp.sqrt(stiffness - half * half)
    decay = jnp.exp(-half * dt)
    cosine, sine = decay * jnp.cos(frequency * dt), decay * jnp.sin(frequency * dt) / frequency

    def axis(off: Scalar, vel: Scalar, drone_vel: Scalar) -> tuple[Scalar, Scalar]:
        slope = vel - drone_vel
        later = cosine * off + sine * (slope + half * off)
        return later, drone_vel + cosine * slope - sine * (half * slope + stiffness * off)

    (off_x, vel_x), (off_y, vel_y) = axis(load[0], load[2], vel_w.x), axis(load[1], load[3], vel_w.y)
    return Pendulum(off_x, off_y, vel_x, vel_y)
