"""Replaying a log through the simulator: what the model says of each row, given the rows before it.

The simulator's own step is used, row after row. It is fed the measured attitude, velocity, position and
voltage, so that one thing that is wrong does not spoil all others; the applied action and what effects
remember follow from the commands, which are exact.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env.dynamics import ModelParameters, advance, integrate_attitude
from flytrack_env.effects import start_memories
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.state import Action, Drone
from flytrack_sysid.record import Record


class Replay(NamedTuple):
    """What the model says of the rows, (num_rows, ...); of the first of a flight it says nothing.

    applied: (4,) the lagged action at the row. rates_b: (3,) rad/s. force_b: (3,) m/s^2, specific force
    of the step to the row, in the attitude before it. acc_w: (3,) m/s^2, the same with gravity, world.
    quat: (4,), integrated from the measured one where ``turns_afresh`` was last true.
    battery_change_v: of the step to the row.
    """

    applied: jax.Array
    rates_b: jax.Array
    force_b: jax.Array
    acc_w: jax.Array
    quat: jax.Array
    battery_change_v: jax.Array


def _drone(row: Record, applied: Action, rates_b: Vec3) -> Drone:
    """Return the drone as measured, with the applied action and rates of the replay."""
    return Drone(
        pos_w=Vec3(*row.pos_w),
        vel_w=Vec3(*row.vel_w),
        acc_w=Vec3(*jnp.zeros_like(row.vel_w)),
        quat=Quaternion(*row.quat),
        rates_b=rates_b,
        applied=applied,
        battery_v=row.battery_v,
    )


def _chosen(condition: jax.Array, yes: Any, no: Any) -> Any:
    return jax.tree.map(partial(jnp.where, condition), yes, no)


def replay(model: ModelParameters, record: Record, turns_afresh: jax.Array) -> Replay:
    """Return what a model says of every row; differentiable in the model.

    turns_afresh: (num_rows,) bool, where the attitude is taken from the log again. In float64 where the
    arguments are, inside of ``jax.enable_x64(True)``.
    """

    def next_row(carry: tuple, inputs: tuple) -> tuple:
        applied, rates_b, memories, quat = carry
        row, is_fresh = inputs
        applied = _chosen(row.begins | row.is_applied_known, Action(*row.applied), applied)
        drone = _drone(row, applied, rates_b)
        memories = _chosen(row.begins, start_memories(model.effects, drone), memories)
        quat = _chosen(row.begins | is_fresh, drone.quat, quat)
        after, memories = advance(drone, memories, Action(*row.command), row.step_s, model)
        force_w = after.acc_w + Vec3(0.0, 0.0, model.g)
        of_next = (after.rates_b, [axis.dot(force_w) for axis in drone.quat.axes()], after.acc_w)
        change_v = after.battery_v - drone.battery_v
        turned = integrate_attitude(quat, after.rates_b, row.step_s)
        return (after.applied, after.rates_b, memories, turned), (applied, quat, of_next, change_v)

    record = jax.tree.map(jnp.asarray, record)
    first = jax.tree.map(lambda column: column[0], record)
    drone = _drone(first, Action(*first.applied), Vec3(*jnp.zeros_like(first.vel_w)))
    start = (drone.applied, drone.rates_b, start_memories(model.effects, drone), drone.quat)
    _, (applied, quat, of_next, change_v) = jax.lax.scan(next_row, start, (record, turns_afresh))

    def stacked(leaves: Any) -> jax.Array:
        return jnp.stack(tuple(leaves), axis=-1)

    def moved_on(values: jax.Array) -> jax.Array:  # said at a row, of the next one
        return jnp.concatenate([jnp.zeros_like(values[:1]), values[:-1]])

    rates_b, force_b, acc_w = (moved_on(stacked(leaves)) for leaves in of_next)
    return Replay(stacked(applied), rates_b, force_b, acc_w, stacked(quat), moved_on(change_v))
