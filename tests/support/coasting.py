"""Drones, rows of gates, and a plant that flies straight on through them."""

from functools import cache

import jax.numpy as jnp
from scipy.spatial.transform import Rotation

from flytrack_env.env import FlyTrack
from flytrack_env.plants import Plant
from flytrack_env.tracks import Gate, Track
from tests.support.simulated_flights import drone_with

FACING_X = (0.5**0.5, 0.0, 0.0, -(0.5**0.5))  # yaw -90 degrees: the gate's local +y is world +x


class Coasting(Plant):
    """A plant that flies straight on at constant velocity, whatever the command."""

    def reset(self, drone, model):
        return drone

    def step(self, state, command, dt, model):
        """Return the drone moved along its velocity."""
        return state._replace(pos_w=state.pos_w + state.vel_w.scale(dt))

    def drone(self, state):
        return state


def drone_at(position, velocity=(0.0, 0.0, 0.0), battery_v=23.5, **fields):
    """Return a drone of float32 leaves; ``fields`` replace the other parts of its state."""
    drone = drone_with(pos_w=position, vel_w=velocity, **fields)
    return drone._replace(battery_v=jnp.float32(battery_v))


def track_of_row(distances):
    """Return a track of gates in a row along +x at these x, flown towards +x."""
    gates = tuple(Gate(i, (x, 0.0, 2.0), FACING_X, 1.0, 1.5, 2.7) for i, x in enumerate(distances))
    low, high = (min(distances) - 100.0, -50.0, 0.0), (max(distances) + 100.0, 50.0, 50.0)
    return Track("row", gates, (min(distances) - 5.0, 0.0, 2.0), (1.0, 0.0, 0.0, 0.0), low, high)


def direction_of_flight(gate):
    """Return the direction in which a gate is flown through, world, from its own data."""
    attitude = Rotation.from_quat(gate.quaternion, scalar_first=True)
    return gate.direction * attitude.as_matrix()[:, 1]


@cache
def coasting_env(*distances):
    """Return the environment of a drone that coasts along a row of gates."""
    return FlyTrack(track=track_of_row(distances), plant=Coasting())
