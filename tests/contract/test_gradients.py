"""Gradients through the environment, for those who ask for them."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.env import EnvParams, EnvState, FlyTrack

YAW_180 = (0.0, 0.0, 0.0, 1.0)


def differentiable(env: FlyTrack, state: EnvState, params: EnvParams) -> Callable[..., Any]:
    """Return a smooth scalar of observation and next state, as a function of action and speed."""

    @jax.jit
    def scalar(action: jax.Array, speed: jax.Array) -> jax.Array:
        drone = env.drone(state)
        plant = state.plant._replace(drone=drone._replace(vel_w=drone.vel_w._replace(y=speed)))
        observation, after, *_ = env.step_env(None, state._replace(plant=plant), action, params)
        return jnp.sum(observation**2) + sum(leaf**2 for leaf in jax.tree.leaves(after.plant))

    return scalar


def test_transition_gradients_are_detached_unless_asked_for(
    env: FlyTrack, params: EnvParams, make_drone: Any
) -> None:
    attached = env.with_transition_gradients()
    assert env.supports_transition_gradients and not env.transition_gradients_enabled
    action, speed = np.array([0.2, -0.3, 0.4, 0.1]), np.array(1.5)
    with jax.enable_x64(True):
        state = env.begin(make_drone((15.0, 2.5, 1.0), (-5.0, 1.0, 0.5)), 0, params)
        state = jax.tree.map(lambda leaf: leaf.astype(float) if leaf.dtype == jnp.float32 else leaf, state)
        detached = jax.grad(differentiable(env, state, params), argnums=(0, 1))(action, speed)
        scalar = differentiable(attached, state, params)
        gradient = jax.grad(scalar, argnums=(0, 1))(action, speed)
        shifts = 1e-6 * np.eye(4)
        numeric = [(scalar(action + s, speed) - scalar(action - s, speed)) / 2e-6 for s in shifts]
        slope = (scalar(action, speed + 1e-6) - scalar(action, speed - 1e-6)) / 2e-6
    assert not np.asarray(detached[0]).any() and not np.asarray(detached[1]).any()
    np.testing.assert_allclose(gradient[0], numeric, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(gradient[1], slope, rtol=1e-4, atol=1e-5)
    assert np.abs(numeric).min() > 1e-6


def test_gradients_of_a_flight_and_its_rewards_are_finite(
    env: FlyTrack, params: EnvParams, make_drone: Any
) -> None:
    attached = env.with_transition_gradients()
    state = env.begin(make_drone((18.6, 2.0, 1.0), quat=YAW_180), 0, params)

    @jax.jit
    @jax.grad
    def gradient(actions: jax.Array) -> jax.Array:
        def one(state: EnvState, action: jax.Array) -> tuple[EnvState, jax.Array]:
            _, state, reward, *_ = attached.step_env(None, state, action, params)
            return state, reward

        return jax.lax.scan(one, state, actions)[1].sum()

    value = np.asarray(gradient(jnp.full((50, 4), 0.1)))
    assert np.isfinite(value).all()
    assert (np.abs(value[0]) > 0.0).all()
