"""What a log measured at every row of its lanes, minus what a model predicts from the row before.

========  ==============================================================================  =======
channel   residual of a row                                                               unit
========  ==============================================================================  =======
``w``     gyro minus the modelled rates, world frame                                      rad/s
``q``     turn since the row before minus the modelled turn, world frame                  rad
``f``     accelerometer minus the modelled specific force, world frame                    m/s^2
``v``     change of velocity since the row before minus the modelled change, world frame  m/s
``v_bat`` change of voltage since the row before minus the modelled change                V
========  ==============================================================================  =======
"""

from typing import Any

import jax
import jax.numpy as jnp

from flytrack_env.dynamics import ModelParameters, read_sensors
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_sysid.diagnosis.lanes import Lanes
from flytrack_sysid.parameters import from_vector
from flytrack_sysid.record import Record
from flytrack_sysid.replay import Step, replay


def _turn(measured: Quaternion, predicted: Quaternion) -> Vec3:
    """Return the small world-frame rotation from a predicted to a measured attitude, rad."""
    conjugate = Quaternion(predicted.w, -predicted.x, -predicted.y, -predicted.z)
    error = measured.multiply(conjugate)
    double = jnp.where(error.w < 0.0, -2.0, 2.0)
    return Vec3(double * error.x, double * error.y, double * error.z)


def _of_step(step: Step, next_row: Record, sensed: dict[str, Any], model: ModelParameters) -> jax.Array:
    """Return the residuals of the row after a step, (NUM_AXES, 2); 0 for absent channels."""
    row, before, after = step.row, step.before, step.after
    axes = before.quat.axes()
    read = read_sensors(before, after, step.later_memories, row.step_s, model)

    def to_world(vector_b: Vec3) -> Vec3:
        return axes[0].scale(vector_b.x) + axes[1].scale(vector_b.y) + axes[2].scale(vector_b.z)

    zero = Vec3(0.0, 0.0, 0.0)
    rates = to_world(Vec3(*sensed["w"]) - read.rates_b) if "w" in sensed else zero
    turn = _turn(Quaternion(*next_row.quat), after.quat)
    force = to_world(Vec3(*sensed["f"]) - read.force_b) if "f" in sensed else zero
    vel_change = Vec3(*next_row.vel_w) - before.vel_w - after.acc_w.scale(row.step_s)
    voltage_change = next_row.battery_v - after.battery_v
    direct, level = (*rates, *force, 0.0), (*turn, *vel_change, voltage_change)
    return jnp.stack([jnp.stack(direct), jnp.stack(level)], axis=-1)


def _of_lane(model: ModelParameters, lane: Record, sensed: dict[str, Any]) -> jax.Array:
    """Return the residuals of a lane's rows; of its first row nothing is predicted."""
    rows, gyro_b = jax.tree.map(lambda leaf: leaf[:-1], (lane, sensed.get("w")))
    later = jax.tree.map(lambda leaf: leaf[1:], (lane, sensed))
    found = replay(
        model, rows, "gyro", gyro_b, lambda step, extra: _of_step(step, extra[0], extra[1], model), later
    )
    return jnp.concatenate([jnp.zeros_like(found[:1]), found])


def residuals(vector: jax.Array, like: ModelParameters, lanes: Lanes) -> jax.Array:
    """Return the residuals of a model, (rows, lanes, NUM_AXES, 2), and 0 where a flight begins.

    vector: the model's numbers, in the order of ``parameters.names_of(like)``.
    """
    model = from_vector(vector, like)
    of_lane = jax.vmap(lambda lane, sensed: _of_lane(model, lane, sensed), in_axes=1, out_axes=1)
    return jnp.where(lanes.is_joined[..., None, None], of_lane(lanes.record, lanes.measured), 0.0)
