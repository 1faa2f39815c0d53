"""Replaying a log through the simulator: what the model says of each row, given the rows before it.

The simulator's own step is used, row after row. It is fed the measured attitude, velocity, position and
voltage, so that one thing that is wrong does not spoil all others; the applied action and what effects
remember follow from the commands, which are exact.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.dynamics import ModelParameters, advance, integrate_attitude, start_rates
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


def drone_of(row: Record, applied: Action, rates_b: Vec3) -> Drone:
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


def chosen(condition: jax.Array | np.ndarray, yes: Any, no: Any) -> Any:
    """Return one of two trees, leaf by leaf."""
    return jax.tree.map(partial(jnp.where, condition), yes, no)


def replay(model: ModelParameters, record: Record, turns_afresh: jax.Array | np.ndarray) -> Replay:
    """Return what a model says of every row; differentiable in the model.

    turns_afresh: (num_rows,) bool, where the attitude is taken from the log again. In float64 where the
    arguments are, inside of ``jax.enable_x64(True)``.
    """
    record = jax.tree.map(jnp.asarray, record)
    applied, rates_b, memories = _remembered(model, record)

    def said_of_next(
        row: Record, applied: Action, rates_b: Vec3, memories: tuple[Any, ...]
    ) -> tuple[Any, ...]:
        drone = drone_of(row, applied, rates_b)
        after, _ = advance(drone, memories, Action(*row.command), row.step_s, model)
        force_w = after.acc_w + Vec3(0.0, 0.0, model.g)
        force_b = Vec3(*(axis.dot(force_w) for axis in drone.quat.axes()))
        return after.rates_b, force_b, after.acc_w, after.battery_v - drone.battery_v

    of_next = jax.vmap(said_of_next)(record, applied, rates_b, memories)
    quat = _turned(record, of_next[0], record.begins | turns_afresh)

    def stacked(leaves: Any) -> jax.Array:
        return jnp.stack(tuple(leaves), axis=-1)

    def moved_on(values: jax.Array) -> jax.Array:  # said at a row, of the next one
        return jnp.concatenate([jnp.zeros_like(values[:1]), values[:-1]])

    rates, force_b, acc_w = (moved_on(stacked(leaves)) for leaves in of_next[:3])
    return Replay(stacked(applied), rates, force_b, acc_w, stacked(quat), moved_on(of_next[3]))


def _remembered(model: ModelParameters, record: Record) -> tuple[Action, Vec3, tuple[Any, ...]]:
    """Return the applied action, body rates and effects' memories at every row.

    Only these follow from the row before; the rest of a step is done for all rows at once.
    """

    def next_row(carry: tuple[Any, ...], row: Record) -> tuple[Any, ...]:
        applied, rates_b, memories = carry
        applied = chosen(row.begins | row.is_applied_known, Action(*row.applied), applied)
        drone = drone_of(row, applied, rates_b)
        drone = drone._replace(rates_b=chosen(row.begins, start_rates(drone, model), rates_b))
        memories = chosen(row.begins, start_memories(model.effects, drone), memories)
        after, later = advance(drone, memories, Action(*row.command), row.step_s, model)
        return (after.applied, after.rates_b, later), (applied, drone.rates_b, memories)

    first = jax.tree.map(lambda column: column[0], record)
    drone = drone_of(first, Action(*first.applied), Vec3(*jnp.zeros_like(first.vel_w)))
    start = (drone.applied, drone.rates_b, start_memories(model.effects, drone))
    return jax.lax.scan(next_row, start, record)[1]


def _turned(record: Record, rates_b: Vec3, is_fresh: jax.Array | np.ndarray) -> Quaternion:
    """Return the attitude that rates lead to at every row, from the measured one where it is fresh."""

    def next_row(quat: Quaternion, inputs: tuple[Any, ...]) -> tuple[Quaternion, Quaternion]:
        measured, rates_b, step_s, is_fresh = inputs
        quat = chosen(is_fresh, measured, quat)
        return integrate_attitude(quat, rates_b, step_s), quat

    measured = Quaternion(*record.quat.T)
    start = jax.tree.map(lambda column: column[0], measured)
    return jax.lax.scan(next_row, start, (measured, rates_b, record.step_s, is_fresh))[1]
