"""Replaying a flight log through the simulator's own step, row after row.

Every row is fed the measured attitude, velocity, position and voltage, so that one error in the
model does not affect all channels. The applied action, the body rates and the effects' memories
follow from the commands, which are known exactly. The fit, the validation and the diagnosis all
replay logs with ``replay_row``.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.dynamics import (
    ModelParameters,
    Moved,
    body_rates,
    move,
    observe_rates,
    read_gyro,
)
from flytrack_env.effects import MAX_DELAY_STEPS, at_row, start_memories, takes_motors
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.state import Action, Drone
from flytrack_sysid.inference.record import Record

# Time over which rates that follow from torques are moved to the gyro's: long against its noise,
# short against what a torque of some tenths of rad/s^2, which a model lacks, adds up to.
OBSERVED_S = 0.1


class Step(NamedTuple):
    """One replayed step.

    Attributes:
        row: the row of the log.
        before: the drone as measured at this row.
        moved: result of the step; ``moved.after`` is the drone as modelled.
        model: the model of the step.
    """

    row: Record
    before: Drone
    moved: Moved
    model: ModelParameters

    @property
    def after(self) -> Drone:
        """The drone after the step."""
        return self.moved.after


def where_true(condition: jax.Array | np.ndarray, yes: Any, no: Any) -> Any:
    """Return ``yes`` or ``no``, two trees of the same structure, leaf by leaf."""
    return jax.tree.map(partial(jnp.where, condition), yes, no)


def measured_drone(row: Record, applied: Action, rates_b: Vec3) -> Drone:
    """Return the drone as measured at a row, with this applied action and these body rates."""
    return Drone(
        pos_w=Vec3(*row.pos_w),
        vel_w=Vec3(*row.vel_w),
        acc_w=Vec3(*jnp.zeros_like(row.vel_w)),
        quat=Quaternion(*row.quat),
        rates_b=rates_b,
        applied=applied,
        battery_v=row.battery_v,
    )


def _observed(
    model: ModelParameters,
    before: Drone,
    memories: tuple[Any, ...],
    row: Record,
    gyro_b: jax.Array,
    share: jax.Array,
) -> tuple[Drone, tuple[Any, ...]]:
    """Return drone and memories with body rates moved to the gyro's by a share of the way.

    From sticks rates follow within a time, from torques the errors of a model add up without end.
    """
    offset_b = Vec3(*gyro_b) - read_gyro(before, memories, row.step_s, model)
    offset_b = where_true(jnp.isnan(gyro_b[0]), Vec3(*jnp.zeros_like(gyro_b)), offset_b)
    rates_b = before.rates_b + offset_b.scale(share)
    return observe_rates(before, memories, rates_b, row.step_s, model)


class ReplayState(NamedTuple):
    """The state of a replay between rows; ``memories`` are those of the effects."""

    applied: Action
    rates_b: Vec3
    memories: tuple[Any, ...]


def start_replay(model: ModelParameters, row: Record) -> ReplayState:
    """Return the initial state at a row at which a flight begins."""
    drone = measured_drone(row, Action(*row.applied), Vec3(*jnp.zeros_like(row.vel_w)))
    memories = start_memories(model.effects, drone, MAX_DELAY_STEPS)
    return ReplayState(drone.applied, drone.rates_b, memories)


def replay_row(
    model: ModelParameters,
    state: ReplayState,
    row: Record,
    gyro_b: jax.Array,
    is_gyro_fed: bool = False,
) -> tuple[ReplayState, Step]:
    """Return the state after a row, and the step from it.

    Differentiable in the model. It computes in float64 inside ``jax.enable_x64(True)``.

    Args:
        model: the replayed model.
        state: before the row; unused where a flight begins there.
        row: of a log.
        gyro_b: rates with which a flight starts, or the step if ``is_gyro_fed``, (3,) rad/s; where
            they are NaN, a flight starts with the rates of the sticks.
        is_gyro_fed: whether the step starts with the measured rates.
    """
    applied = where_true(row.begins | row.is_applied_known, Action(*row.applied), state.applied)
    steady_b = body_rates(applied, model.max_rate)
    first_b = where_true(jnp.isnan(gyro_b[0]), steady_b, Vec3(*gyro_b))
    rates_b = first_b if is_gyro_fed else where_true(row.begins, first_b, state.rates_b)
    of_motors = takes_motors(model.effects)
    rates_b = steady_b if of_motors else rates_b  # the applied action has them
    before = measured_drone(row, applied, rates_b)
    # The logged action, which is the applied one where a flight begins: so past commands depend on
    # no model of a batch.
    begun = before._replace(applied=Action(*row.applied))
    memories = where_true(
        row.begins, start_memories(model.effects, begun, MAX_DELAY_STEPS), state.memories
    )
    memories = at_row(memories, row.time_s)
    if of_motors:
        share = 1.0 - jnp.exp(-row.step_s / OBSERVED_S)
        share = jnp.where(row.begins | is_gyro_fed, 1.0, share)
        before, memories = _observed(model, before, memories, row, gyro_b, share)
    moved = move(before, memories, Action(*row.command), row.step_s, model)
    after = ReplayState(moved.after.applied, moved.after.rates_b, moved.memories)
    return after, Step(row, before, moved, model)
