"""The drone's state, and the packed (21,) vector of the handout: the one place for its layout.

========  =====================================================  =======
index     quantity                                               unit
========  =====================================================  =======
0:3       position, world                                        m
3:6       velocity, world                                        m/s
6:9       acceleration, world (0 in hover, -g in free fall)      m/s^2
9:13      orientation quaternion w, x, y, z, body to world       1
13:16     angular velocity, body                                 rad/s
16:20     applied (lagged) action: roll, pitch, yaw, thrust      1
20        battery voltage                                        V
========  =====================================================  =======
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.quaternion import Quaternion, Scalar, Vec3

STATE_SIZE = 21
ACTION_SIZE = 4

POSITION = slice(0, 3)
VELOCITY = slice(3, 6)
ACCELERATION = slice(6, 9)
QUATERNION = slice(9, 13)
RATES = slice(13, 16)
APPLIED_ACTION = slice(16, 20)
BATTERY = 20

BATTERY_FULL_V = 24.0  # of the handout; a model's own: ``battery.Battery``
BATTERY_EMPTY_V = 22.0


class Action(NamedTuple):
    """Stick positions roll, pitch, yaw, thrust in [-1, 1]; thrust from -1 (none) to +1 (full)."""

    roll: Scalar
    pitch: Scalar
    yaw: Scalar
    thrust: Scalar


class Drone(NamedTuple):
    """State of one drone, a scalar per leaf.

    Attributes:
        pos_w, vel_w, acc_w: world, m, m/s, m/s^2; the acceleration is the mean over the step that
            led here.
        quat: body to world.
        rates_b: body, rad/s.
        applied: the lagged action.
        battery_v: V.
    """

    pos_w: Vec3
    vel_w: Vec3
    acc_w: Vec3
    quat: Quaternion
    rates_b: Vec3
    applied: Action
    battery_v: Scalar


def pack(drone: Drone) -> jax.Array:
    """Return the drone as the handout's state vector, shape (21,), float32 unless x64 is on."""
    return jnp.stack([jnp.asarray(leaf) for leaf in jax.tree.leaves(drone)])


def unpack(x: jax.Array) -> Drone:
    """Return the drone that a state vector of shape (21,) describes.

    Raises:
        ValueError: if ``x`` has another shape.
    """
    if jnp.shape(x) != (STATE_SIZE,):
        raise ValueError(f"x: found shape {jnp.shape(x)}, expected ({STATE_SIZE},)")
    return Drone(
        pos_w=Vec3(*(x[i] for i in range(0, 3))),
        vel_w=Vec3(*(x[i] for i in range(3, 6))),
        acc_w=Vec3(*(x[i] for i in range(6, 9))),
        quat=Quaternion(*(x[i] for i in range(9, 13))),
        rates_b=Vec3(*(x[i] for i in range(13, 16))),
        applied=Action(*(x[i] for i in range(16, 20))),
        battery_v=x[BATTERY],
    )


def unpack_action(u: jax.Array) -> Action:
    """Return the action that a vector of shape (4,) describes.

    Raises:
        ValueError: if ``u`` has another shape.
    """
    if jnp.shape(u) != (ACTION_SIZE,):
        raise ValueError(f"action: found shape {jnp.shape(u)}, expected ({ACTION_SIZE},)")
    return Action(*(u[i] for i in range(ACTION_SIZE)))
