"""Time from a stick step to half of the response, by axis: delay, lags and limits together."""

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
from flytrack_sysid.parameters import from_vector, in_batches, to_vector
from flytrack_sysid.trace_cache import keep_trace

SMALL_STEP, FULL_STEP = 1e-3, 1.0  # of a stick, from its centre; no limit acts on the small one
STEP_S, WATCHED_S = 1e-3, 1.5
FRAME_S = 0.01  # of a loop that is fed by frames of a receiver, in place of the step
HALF = 0.5
HEIGHT_M = 1e3  # far from the ground
BATCH = 8  # models at once


def half_response_s(model: ModelParameters, stick_step: float = SMALL_STEP) -> np.ndarray:
    """Return the times, (4,) s, from a step of each stick to half of the steady change.

    The sticks are roll, pitch, yaw and thrust; the responses are the body rates and the thrust of a
    drone that moves continuously. Delays of its sensors are not included. NaN where the response
    takes longer than 1.5 s, or there is none. stick_step: from the centre, which for thrust is half
    a stick.
    """
    with jax.enable_x64(True):
        like = jax.tree.map(lambda leaf: np.asarray(leaf, float), model)
        return half_responses(to_vector(like)[None], like, stick_step)[0]


def half_responses(vectors: np.ndarray, like: ModelParameters, stick_step: float) -> np.ndarray:
    """Return ``half_response_s`` of models as vectors, (num_models, 4) s.

    Call it inside ``jax.enable_x64(True)``.

    vectors: (num_models, parameters), in the order of ``parameters.names_of(like)``.
    """
    return in_batches(lambda part: _half_responses(part, like, stick_step), vectors, BATCH)


@keep_trace
def _half_responses(vectors: jax.Array, like: ModelParameters, stick_step: jax.Array) -> jax.Array:
    return jax.vmap(lambda vector: _of_model(from_vector(vector, like), stick_step))(vectors)


def _of_model(model: ModelParameters, stick_step: jax.Array) -> jax.Array:
    """Return the times of the four sticks, (4,) s; dead times come before all else and only add."""
    dead_s = jnp.stack(jnp.broadcast_arrays(*dead_times(model.effect("command_delay"))))
    others = tuple(one for one in model.effects if not isinstance(one, CommandDelay))
    prompt = model._replace(effects=others, motion=Motion.CONTINUOUS, battery_drain_v_per_min=0.0)
    return dead_s + jax.vmap(lambda stick: _of_stick(prompt, stick, stick_step))(
        jnp.eye(ACTION_SIZE)
    )


def _of_stick(model: ModelParameters, stick: jax.Array, stick_step: jax.Array) -> jax.Array:
    """Return the time of one stick, s, for a drone held in place.

    stick: a row of the unit matrix.
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

    at_once = model._replace(motion=Motion.HANDOUT)
    values = jax.lax.scan(step, (drone, memories), length=round(WATCHED_S / step_s))[1]
    before, steady = (
        response(move(drone, memories, held, STEP_S if has_loop else HELD_S, at_once))
        for held in (drone.applied, command)
    )
    steady = values[-1] if has_loop else steady
    return step_s * _first_crossing((values - before) / (steady - before))


def _standing(model: ModelParameters) -> Drone:
    """Return a level drone at rest with all sticks centred, turning as it steadily does."""
    still, zero = Vec3(*jnp.zeros(3)), jnp.zeros(())
    drone = Drone(
        pos_w=Vec3(zero, zero, zero + HEIGHT_M),
        vel_w=still,
        acc_w=still,
        quat=Quaternion(zero + 1.0, zero, zero, zero),
        rates_b=still,
        applied=Action(*jnp.zeros(ACTION_SIZE)),
        battery_v=zero + model.battery.voltage(0.5),
    )
    return drone._replace(rates_b=start_rates(drone, model))


def _first_crossing(shares: jax.Array) -> jax.Array:
    """Return after how many steps shares, (num_steps,), first pass a half; NaN if never.

    The first share is that after one step.
    """
    shares = jnp.concatenate([jnp.zeros(1), shares])
    is_past = shares >= HALF
    place = jnp.argmax(is_past)
    before, after = shares[place - 1], shares[place]
    return jnp.where(is_past.any(), place - (after - HALF) / (after - before), jnp.nan)
