"""What a model says of every row of a log's lanes, and what was measured beyond that.

========  ====================================================================================  =======
channel   residual of a row                                                                     unit
========  ====================================================================================  =======
``w``     gyro less the rates that the commands lead to, world frame                            rad/s
``q``     turn since the row before less the turn of those rates, world frame                   rad
``f``     accelerometer less the model's specific force, world frame                            m/s^2
``v``     change of velocity since the row before less the model's, world frame                 m/s
``v_bat`` change of voltage since the row before less the model's                               V
========  ====================================================================================  =======

The measured attitude, velocity, position and voltage are fed into the model row by row; only what follows
from the commands alone (applied action, rates, what effects remember) is carried on by the model.
"""

import jax
import jax.numpy as jnp

from flytrack_env.dynamics import ModelParameters, Reading, advance, body_rates, read_sensors
from flytrack_env.effects import start_memories
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.state import Action, Drone
from flytrack_sysid.diagnosis.lanes import Lanes
from flytrack_sysid.parameters import from_vector
from flytrack_sysid.record import Record
from flytrack_sysid.replay import chosen, drone_of


def _turn(measured: Quaternion, said: Quaternion) -> Vec3:
    """Return the small world-frame rotation from what is said to what was measured, rad."""
    conjugate = Quaternion(said.w, -said.x, -said.y, -said.z)
    error = measured.multiply(conjugate)
    double = jnp.where(error.w < 0.0, -2.0, 2.0)
    return Vec3(double * error.x, double * error.y, double * error.z)


def _of_step(
    row: Record, next_row: Record, drone: Drone, after: Drone, read: Reading, sensed: dict[str, jax.Array]
) -> jax.Array:
    """Return the residuals of the row after one step, (NUM_AXES, 2); 0 for channels that are absent."""
    axes = drone.quat.axes()

    def to_world(vector_b: Vec3) -> Vec3:
        return axes[0].scale(vector_b.x) + axes[1].scale(vector_b.y) + axes[2].scale(vector_b.z)

    nothing = Vec3(0.0, 0.0, 0.0)
    spun = to_world(Vec3(*sensed["w"]) - read.rates_b) if "w" in sensed else nothing
    turned = _turn(Quaternion(*next_row.quat), after.quat)
    pushed = to_world(Vec3(*sensed["f"]) - read.force_b) if "f" in sensed else nothing
    moved = Vec3(*next_row.vel_w) - drone.vel_w - after.acc_w.scale(row.step_s)
    drained = next_row.battery_v - after.battery_v
    return jnp.stack([jnp.stack([*spun, *pushed, 0.0]), jnp.stack([*turned, *moved, drained])], axis=-1)


def _first_rates(drone: Drone, sensed: dict[str, jax.Array], model: ModelParameters) -> Vec3:
    """Return the rates with which a flight begins: what the gyro says, else what the sticks ask for."""
    return Vec3(*sensed["w"]) if "w" in sensed else body_rates(drone.applied, model.max_rate)


def _of_lane(model: ModelParameters, lane: Record, sensed: dict[str, jax.Array]) -> jax.Array:
    """Return the residuals of a lane's rows, step after step; of its first row nothing is said."""
    rows, sensed_before = jax.tree.map(lambda leaf: leaf[:-1], (lane, sensed))
    later, sensed = jax.tree.map(lambda leaf: leaf[1:], (lane, sensed))

    def step(carry: tuple, inputs: tuple) -> tuple:
        row, next_row, sensed_before, sensed = inputs
        applied, rates_b, memories = carry
        applied = chosen(row.begins | row.is_applied_known, Action(*row.applied), applied)
        drone = drone_of(row, applied, rates_b)
        drone = drone._replace(rates_b=chosen(row.begins, _first_rates(drone, sensed_before, model), rates_b))
        memories = chosen(row.begins, start_memories(model.effects, drone), memories)
        after, memories = advance(drone, memories, Action(*row.command), row.step_s, model)
        read = read_sensors(drone, after, memories, row.step_s, model)
        found = _of_step(row, next_row, drone, after, read, sensed)
        return (after.applied, after.rates_b, memories), found

    first = jax.tree.map(lambda column: column[0], lane)
    drone = drone_of(first, Action(*first.applied), Vec3(*jnp.zeros_like(first.vel_w)))
    start = (drone.applied, drone.rates_b, start_memories(model.effects, drone))
    found = jax.lax.scan(step, start, (rows, later, sensed_before, sensed))[1]
    return jnp.concatenate([jnp.zeros_like(found[:1]), found])


def unexplained(vector: jax.Array, like: ModelParameters, lanes: Lanes) -> jax.Array:
    """Return what a model leaves, (rows, lanes, NUM_AXES, 2), and 0 where a flight begins."""
    model = from_vector(vector, like)
    of_lane = jax.vmap(lambda lane, sensed: _of_lane(model, lane, sensed), in_axes=1, out_axes=1)
    return jnp.where(lanes.is_joined[..., None, None], of_lane(lanes.record, lanes.measured), 0.0)
