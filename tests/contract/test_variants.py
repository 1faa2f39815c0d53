"""Every registered id: reproducible, differentiable, and randomised the way reality is."""

import hashlib
import subprocess
import sys
from typing import Any

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import flytrack_env
from flytrack_env.dynamics import collective_thrust
from flytrack_env.effects import CommandDelay, ThrustScale
from flytrack_env.registration import ENVIRONMENTS
from flytrack_env.state import Action
from flytrack_env.wrappers import RandomizationParams

# The plain id and the one with everything in every run; those between them take as long to compile.
FAST = ("FlyTrack-v0", "FlyTrackRobust-v0")
OVER_IDS = pytest.mark.parametrize(
    "env_id",
    [pytest.param(env_id, marks=() if env_id in FAST else pytest.mark.slow) for env_id in ENVIRONMENTS],
)
NUM_STEPS = 25


def trajectory(env_id: str) -> np.ndarray:
    """Return observations and rewards of a seeded flight through several episodes, (NUM_STEPS, size + 1)."""
    env, params = gymnax.make(env_id)
    params = params.replace(max_steps_in_episode=10)
    _, state = env.reset(jax.random.key(3), params)
    actions = jax.random.uniform(jax.random.key(4), (NUM_STEPS, 4), minval=-1.0)
    keys = jax.random.split(jax.random.key(5), NUM_STEPS)
    rows = []
    for key, action in zip(keys, actions, strict=True):
        observation, state, reward, *_ = env.step(key, state, action, params)
        rows.append(np.append(np.asarray(observation), np.asarray(reward)))
    return np.array(rows)


def digest(env_id: str) -> str:
    """Return a digest of an id's trajectory, every bit of it."""
    return hashlib.sha256(trajectory(env_id).tobytes()).hexdigest()


@OVER_IDS
def test_identical_seeds_fly_identically_in_another_process(env_id: str) -> None:
    code = f"from tests.contract.test_variants import digest; print(digest({env_id!r}))"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as other:
        here = digest(env_id)
        output, _ = other.communicate(timeout=300)
    assert output.strip().splitlines()[-1] == here


@OVER_IDS
def test_without_jit_it_flies_the_same(env_id: str) -> None:
    """Within 1e-5: a reset, steps each from its own last state, and an end with its reset."""
    env, params = gymnax.make(env_id)
    params = params.replace(max_steps_in_episode=3)

    def flight(reset: Any, step: Any) -> list[Any]:
        results = [reset(jax.random.key(3), params)]
        for i, action in enumerate(jax.random.uniform(jax.random.key(4), (4, 4), minval=-1.0)):
            results.append(step(jax.random.key(i), results[-1][1], action, params))
        return results

    compiled = flight(jax.jit(env.reset), env.step)
    with jax.disable_jit():
        plain = flight(env.reset, env.step)
    assert bool(compiled[3][4]) and not bool(compiled[2][4])  # truncated after three steps
    for a, b in zip(jax.tree.leaves(compiled), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


@OVER_IDS
def test_gradients_are_those_of_finite_differences(env_id: str, make_drone: Any) -> None:
    """Through five steps in free flight, away from every gate, in every action of the first one."""
    env, params = gymnax.make(env_id)
    env = env.with_transition_gradients()
    drone = make_drone((14.0, 12.0, 3.0), (3.0, -2.0, 1.0), applied=Action(0.1, -0.1, 0.2, 0.0))
    state = env.begin(drone, 0, params, jnp.uint32(11))
    later = jax.random.uniform(jax.random.key(1), (4, 4), minval=-0.5, maxval=0.5)
    weights = jax.random.normal(jax.random.key(2), env.observation_space(params).shape)

    @jax.jit
    def value(action: jax.Array) -> jax.Array:
        flown = state
        for i in range(5):
            command = action if i == 0 else later[i - 1]
            observation, flown, *_ = env.step_env(None, flown, command, params)
        return weights @ observation

    action = jnp.array([0.2, -0.3, 0.1, 0.4])
    found = np.asarray(jax.jit(jax.grad(value))(action))
    shifts = 0.05 * np.eye(4, dtype=np.float32)
    expected = [float(value(action + shift) - value(action - shift)) / 0.1 for shift in shifts]
    assert np.abs(expected).max() > 0.05
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=2e-3)


@OVER_IDS
def test_gradients_stop_unless_asked_for(env_id: str) -> None:
    env, params = gymnax.make(env_id)
    _, state = env.reset(jax.random.key(0), params)
    slope = jax.grad(lambda action: env.step_env(None, state, action, params)[0].sum())(jnp.zeros(4))
    np.testing.assert_array_equal(slope, 0.0)
    assert env.with_transition_gradients().transition_gradients_enabled
    assert not env.transition_gradients_enabled


def hover_command(model: Any, battery_v: float) -> np.ndarray:
    """Return the thrust command at which each model's thrust is its weight, by bisection."""
    coeffs = np.asarray(model.thrust_coeffs, float)[0]  # the same for all: their factor is drawn
    factor = np.asarray(model.effect("thrust_scale").factor)
    low, high = np.full(factor.shape, -1.0), np.full(factor.shape, 1.0)
    for _ in range(40):
        middle = 0.5 * (low + high)
        is_lifting = factor * collective_thrust(middle, battery_v, coeffs) > np.asarray(model.m) * model.g
        low, high = np.where(is_lifting, low, middle), np.where(is_lifting, middle, high)
    return middle


def test_a_heavier_drone_hovers_at_another_command(make_drone: Any) -> None:
    """Each sampled drone hangs still at the command that physics says, and only there."""
    env, params = gymnax.make("FlyTrackRandomized-v0")
    # In still air, without the delay: what is left is mass, thrust, lags.
    low, high = (CommandDelay(0.0), ThrustScale(0.85)), (CommandDelay(0.0), ThrustScale(1.15))
    params = params.replace(wrappers={"domain_randomization": RandomizationParams(low=low, high=high)})
    seeds, battery_v = jnp.arange(200, dtype=jnp.uint32), 23.5
    models = jax.vmap(lambda seed: env.model(env.begin(make_drone((0, 0, 2)), 0, params, seed), params))(
        seeds
    )
    commands = jnp.asarray(hover_command(models, battery_v), jnp.float32)

    def climb(seed: jax.Array, thrust: jax.Array) -> jax.Array:
        applied = Action(0.0, 0.0, 0.0, thrust)
        drone = make_drone((15.0, 10.0, 2.0), battery_v=battery_v)._replace(applied=applied)
        state = env.begin(drone, 0, params, seed)
        state = env.advance(state, applied, params)[0]
        return env.drone(state).acc_w.z

    climb = jax.jit(jax.vmap(climb))
    np.testing.assert_allclose(climb(seeds, commands), 0.0, atol=2e-3)
    nominal = jnp.full(200, np.median(commands))
    # At one command for all, each climbs or sinks by what its thrust exceeds its weight.
    thrust = collective_thrust(nominal, battery_v, params.model.thrust_coeffs)
    excess = models.effects[1].factor * thrust / models.m - params.model.g
    np.testing.assert_allclose(climb(seeds, nominal), excess, atol=2e-3)
    weight_per_thrust = np.asarray(models.m / models.effects[1].factor)
    order = np.argsort(weight_per_thrust)
    assert (np.diff(np.asarray(commands)[order]) > -1e-5).all()
    assert np.ptp(commands) > 0.1


def test_names_are_the_ids() -> None:
    for env_id in ENVIRONMENTS:
        assert flytrack_env.make(env_id).name == env_id
