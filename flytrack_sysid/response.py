"""Time from a step of a stick to half of the response, by axis: delay, lags and limits together."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.dynamics import HELD_S, ModelParameters, Moved, move, start_rates
from flytrack_env.effects import CommandDelay, acts, start_memories
from flytrack_env.effects.command_delay import dead_times
from flytrack_env.motion import Motion
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.state import ACTION_SIZE, Action, Drone
from flytrack_sysid.inference.parameters import from_vector, in_batches, in_float64, to_vector
from flytrack_sysid.inference.trace_cache import keep_trace

SMALL_STEP, FULL_STEP = 1e-3, 1.0  # of a stick, from its centre; no limit acts on the small one
STEP_S, WATCHED_S = 1e-3, 1.5
FRAME_S = 0.01  # step of a loop that gets its commands from frames of a receiver
HALF = 0.5
HEIGHT_M = 1e3  # far from the ground
BATCH = 8  # models at once


def half_response_s(model: ModelParameters, stick_step: float = SMALL_STEP) -> np.ndarray:
    """Return the times from a step of each stick to half of the steady change, (4,) s.

    The sticks are roll, pitch, yaw and thrust. The responses are the body rates and the thrust of a
    drone that moves continuously. Delays of sensors are not included. A time is NaN if the response
    takes longer than 1.5 s, or if there is none.

    Args:
        model: the drone.
        stick_step: from the centre, which for thrust is half a stick.
    """
    with jax.enable_x64(True):
        like = in_float64(model)
        return half_responses(to_vector(like)[None], like, stick_step)[0]


def half_responses(vectors: np.ndarray, like: ModelParameters, stick_step: float) -> np.ndarray:
    """Return ``half_response_s`` of models as vectors, (num_models, 4) s.

    Call it inside ``jax.enable_x64(True)``.

    Args:
        vectors: in the order of ``parameters.names_of(like)``, (num_models, num_parameters).
        like: a model of the same structure.
        stick_step: from the centre.
    """
    return in_batches(lambda batch: _half_responses(batch, like, stick_step), vectors, BATCH)


@keep_trace
def _half_responses(vectors: jax.Array, like: ModelParameters, stick_step: jax.Array) -> jax.Array:
    return jax.vmap(lambda vector: _of_model(from_vector(vector, like), stick_step))(vectors)


def _of_model(model: ModelParameters, stick_step: jax.Array) -> jax.Array:
    """Return the times of the four sticks, (4,) s; dead times precede all else and only add."""
    dead_s = jnp.stack(jnp.broadcast_arrays(*dead_times(model.effect("command_delay"))))
    other_effects = tuple(
        effect for effect in model.effects if not isinstance(effect, CommandDelay)
    )
    undelayed = model._replace(
        effects=other_effects, motion=Motion.CONTINUOUS, battery_drain_v_per_min=0.0
    )
    return dead_s + jax.vmap(lambda stick: _of_stick(undelayed, stick, stick_step))(
        jnp.eye(ACTION_SIZE)
    )


def _of_stick(model: ModelParameters, stick: jax.Array, stick_step: jax.Array) -> jax.Array:
    """Return the time of one stick, s, for a drone held in place.

    Args:
        model: without delay of the commands.
        stick: row of the unit matrix, (4,).
        stick_step: from the centre.
    """
    drone = _standing(model)
    has_loop = acts(model.effects, "respond")
    step_s = FRAME_S if has_loop else STEP_S
    memories, command = start_memories(model.effects, drone), Action(*(stick_step * stick))

    def response(moved: Moved) -> jax.Array:
        return jnp.stack([*moved.after.rates_b, moved.context.force_b.z]) @ stick

    def step(state: tuple[Drone, tuple[Any, ...]], _: None) -> tuple[Any, jax.Array]:
        moved = move(*state, command, step_s, model)
        held = drone._replace(rates_b=moved.after.rates_b, applied=moved.after.applied)
        return (held, moved.memories), response(moved)

    at_once = model._replace(motion=Motion.EULER)
    values = jax.lax.scan(step, (drone, memories), length=round(WATCHED_S / step_s))[1]
    before, steady = (
        response(move(drone, memories, held, STEP_S if has_loop else HELD_S, at_once))
        for held in (drone.applied, command)
    )
    steady = values[-1] if has_loop else steady
    return step_s * _first_crossing((values - before) / (steady - before))


def _standing(model: ModelParameters) -> Drone:
    """Return a level drone at rest with all sticks centred, at its steady body rates."""
    zero_vector, zero = Vec3(*jnp.zeros(3)), jnp.zeros(())
    drone = Drone(
        pos_w=Vec3(zero, zero, zero + HEIGHT_M),
        vel_w=zero_vector,
        acc_w=zero_vector,
        quat=Quaternion(zero + 1.0, zero, zero, zero),
        rates_b=zero_vector,
        applied=Action(*jnp.zeros(ACTION_SIZE)),
        battery_v=zero + model.battery.voltage(0.5),
    )
    return drone._replace(rates_b=start_rates(drone, model))


def _first_crossing(shares: jax.Array) -> jax.Array:
    """Return the number of steps after which shares first reach a half; NaN if they never do.

    Args:
        shares: of the steady change, from the first step on, (num_steps,).
    """
    shares = jnp.concatenate([jnp.zeros(1), shares])
    is_past = shares >= HALF
    index = jnp.argmax(is_past)
    before, after = shares[index - 1], shares[index]
    return jnp.where(is_past.any(), index - (after - HALF) / (after - before), jnp.nan)
