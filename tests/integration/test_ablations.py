"""Ablated observations: only what is meant to be gone is gone, and the race is the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.ablated import WORLD, InWorldFrame, WithoutEntries
from benchmarks.ablations import ABLATIONS, make_env, with_delay
from flytrack_env import make, nominal_parameters
from flytrack_env.quaternion import Vec3


def rows_of(table, key):
    start = 0
    for entry in table:
        if entry.key == key:
            return slice(start, start + entry.size)
        start += entry.size
    raise KeyError(key)


@pytest.fixture(scope="module")
def started():
    env = make("FlyTrack-v0")
    return env, *env.reset(jax.random.key(5), env.default_params)


def test_entries_are_gone_and_the_others_stay(started):
    env, observation, _ = started
    shown, _ = WithoutEntries(env, ("applied", "next_gate")).reset(jax.random.key(5), env.default_params)
    gone = np.zeros(len(observation), bool)
    for key in ("applied", "next_gate"):
        gone[rows_of(env.observation_table, key)] = True
    assert np.all(np.asarray(observation)[rows_of(env.observation_table, "next_gate")][:2] != 0.0)
    np.testing.assert_array_equal(shown, np.where(gone, 0.0, observation))


@pytest.mark.slow
def test_the_world_frame_shows_the_same_in_another_frame(started):
    env, observation, state = started
    world = InWorldFrame(env)
    shown, _ = world.reset(jax.random.key(5), env.default_params)
    drone, gate = env.drone(state), env.race(state).gate

    def shown_as(key):
        entry = next(one for one in WORLD if one.key == key)
        return np.asarray(shown[rows_of(WORLD, key)]) * entry.scale

    np.testing.assert_allclose(shown_as("position"), drone.pos_w, rtol=1e-6)
    np.testing.assert_allclose(shown_as("velocity"), drone.vel_w, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(shown_as("gate"), gate.centre - drone.pos_w, rtol=1e-5, atol=1e-5)
    matrix = shown_as("attitude").reshape(3, 3)  # body to world
    np.testing.assert_allclose(
        matrix @ [0.0, 0.0, 1.0], drone.quat.rotate(Vec3(0.0, 0.0, 1.0)), rtol=1e-5, atol=1e-6
    )
    for key in ("rates", "applied", "battery"):
        np.testing.assert_array_equal(
            shown[rows_of(WORLD, key)], observation[rows_of(env.observation_table, key)]
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["world_frame", "no_action", "randomised", "delay_history"])
def test_every_environment_flies(name):
    ablation = ABLATIONS[name]
    env = make_env(ablation, model=with_delay(nominal_parameters(), ablation.delay_s))
    params = env.default_params
    observation, state = env.reset(jax.random.key(0), params)
    observation, _, reward, _, _, _ = env.step(jax.random.key(1), state, jnp.zeros(4), params)
    assert np.isfinite(reward) and env.observation_space(params).contains(observation)
