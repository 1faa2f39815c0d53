"""A load on a string below the drone, as a pendulum of small swings that the drone's velocity drives.

What a law of ``flytrack_env.effects.grammar`` remembers of it; how hard the load pulls is the law's.
"""

from typing import NamedTuple

from flytrack_env.quaternion import Scalar, Vec3

GRAVITY = 9.81  # m/s^2
SHORTEST_M = 0.05  # of strings: shorter ones swing too fast for steps of 100 Hz


class Pendulum(NamedTuple):
    """How far a load is off the point below the drone, m, and its velocity, m/s; world, horizontal."""

    off_x: Scalar
    off_y: Scalar
    vel_x: Scalar
    vel_y: Scalar


def hanging(vel_w: Vec3) -> Pendulum:
    """Return a load that hangs still below a drone with this velocity, m/s."""
    return Pendulum(0.0 * vel_w.x, 0.0 * vel_w.y, vel_w.x, vel_w.y)


def swung(load: Pendulum, vel_w: Vec3, dt: Scalar, length: float, damping: float) -> Pendulum:
    """Return a load a step later: off'' = -acc - g / length off - damping off', semi-implicit.

    vel_w: of the drone, m/s. dt: s. length: of the string, m. damping: 1/s.
    """

    def axis(off: Scalar, vel: Scalar, drone_vel: Scalar) -> tuple[Scalar, Scalar]:
        vel = vel - dt * (GRAVITY / length * off + damping * (vel - drone_vel))
        return off + dt * (vel - drone_vel), vel

    (off_x, vel_x), (off_y, vel_y) = axis(load[0], load[2], vel_w.x), axis(load[1], load[3], vel_w.y)
    return Pendulum(off_x, off_y, vel_x, vel_y)
