"""The observation: what the policy sees, in the current gate's flight frame, scaled to about 1.

The flight frame of a gate is x along the direction of flight, y left, z the gate's up
(``flytrack_env.tracks``). ``OBSERVATION`` is the table, index by index; a value is the quantity
divided by its scale, clipped to the range.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.battery import Battery
from flytrack_env.fusion import compute_once
from flytrack_env.quaternion import Scalar
from flytrack_env.state import Drone
from flytrack_env.tracks import GateFrame


class Entry(NamedTuple):
    """Rows of the observation that belong together: value = quantity / scale, within +-limit.

    Attributes:
        key: for code.
        name: for people.
        size: number of rows.
        frame, unit: of the quantity.
    """

    key: str
    name: str
    size: int
    frame: str
    unit: str
    scale: float
    limit: float


OBSERVATION = (
    Entry("position", "position relative to the gate's centre", 3, "gate", "m", 3.0, 30.0),
    Entry("velocity", "velocity", 3, "gate", "m/s", 5.0, 12.0),
    Entry("attitude", "rotation matrix body to gate, row by row", 9, "gate", "1", 1.0, 1.0),
    Entry("rates", "angular velocity", 3, "body", "rad/s", 5.0, 3.0),
    Entry("applied", "previous applied action: roll, pitch, yaw, thrust", 4, "body", "1", 1.0, 1.0),
    Entry("battery", "battery voltage, from -1 at empty to 1 at full", 1, "-", "1", 1.0, 1.0),
    Entry(
        "next_gate", "next gate's centre relative to the gate's centre", 3, "gate", "m", 5.0, 20.0
    ),
    Entry("next_direction", "next gate's direction of flight", 3, "gate", "1", 1.0, 1.0),
)
OBSERVATION_SIZE = sum(entry.size for entry in OBSERVATION)


def observe_race(
    drone: Drone, gate: GateFrame, next_gate: GateFrame, battery: Battery
) -> list[jax.Array]:
    """Return the observation of a drone before ``gate``: OBSERVATION_SIZE scalars, float32.

    ``drone`` is as the sensors report it. Scalars, so that wrappers can add to them and they are
    stacked once: a concatenation of batches is slow.
    """
    left = compute_once(gate.left())
    frame = (gate.forward, left, gate.up)
    body_axes = drone.quat.axes()
    quantities: list[tuple[Scalar, ...]] = [
        tuple(axis.dot(drone.pos_w - gate.centre) for axis in frame),
        tuple(axis.dot(drone.vel_w) for axis in frame),
        tuple(axis.dot(body_axis) for axis in frame for body_axis in body_axes),
        drone.rates_b,
        drone.applied,
        (battery.scaled(drone.battery_v),),
        tuple(axis.dot(next_gate.centre - gate.centre) for axis in frame),
        tuple(axis.dot(next_gate.forward) for axis in frame),
    ]
    return [
        jnp.clip(value * (1.0 / entry.scale), -entry.limit, entry.limit)
        for entry, group in zip(OBSERVATION, quantities, strict=True)
        for value in group
    ]
