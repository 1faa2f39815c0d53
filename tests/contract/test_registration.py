"""Every registered id: made, reproducible, differentiable."""

import importlib
import subprocess
import sys
from functools import partial

import chex
import gymnasium
import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.registration import registered_envs
from numpy.testing import assert_allclose

import flytrack_env
from flytrack_env import FlyTrack
from flytrack_env.dynamics import nominal_parameters
from flytrack_env.effects import ThrustScale
from flytrack_env.extras import check_gymnax
from flytrack_env.registration import ARGUMENTS, ENVIRONMENTS, make, register_all
from flytrack_env.state import Action
from flytrack_env.wrappers import DomainRandomization, layers_of
from tests.support.coasting import Coasting, drone_at
from tests.support.compiling import quick_jit
from tests.support.slow import slow_but

CAUSES = ("crash", "ground", "out_of_bounds", "missed_gate", "battery_empty")
RACE = ("gates_passed", "laps", "lap_completed", "lap_time_s", "gate_distance_m")
BASE, EVERY_WRAPPER = "FlyTrack-v0", "FlyTrackRobust-v0"
OVER_KINDS = pytest.mark.parametrize("env_id", slow_but([BASE], [BASE, EVERY_WRAPPER]))
OVER_IDS = pytest.mark.parametrize("env_id", ENVIRONMENTS)


# The others are parts of these.
WHOLE = [
    BASE,
    EVERY_WRAPPER,
    *(f"FlyTrack{name}-v0" for name in ("CornersRobust", "Mask", "Motors")),
]


@pytest.mark.parametrize("env_id", slow_but(WHOLE, ENVIRONMENTS))
def test_every_id_follows_gymnaxs_protocol(env_id):
    first, first_params = gymnax.make(env_id)
    importlib.reload(flytrack_env)
    register_all()
    env, params = gymnax.make(env_id)
    assert first is not env and list(registered_envs).count(env_id) == 1
    assert jax.tree.structure(first_params) == jax.tree.structure(params)
    assert env.name == env_id
    key = jax.random.key(0)
    begun = jax.eval_shape(env.reset, key, params)
    action = jax.eval_shape(env.action_space(params).sample, key)
    observation, state, reward, terminated, truncated, info = jax.eval_shape(
        env.step, key, begun[1], action
    )
    assert (observation, state) == begun and info["final_observation"] == observation
    space = env.observation_space(params)
    assert (observation.shape, observation.dtype) == (space.shape, space.dtype)
    assert observation.dtype == (np.float32 if env.image_shape is None else np.uint8)
    assert reward == jax.ShapeDtypeStruct((), np.float32)
    assert terminated == truncated == jax.ShapeDtypeStruct((), bool)
    assert {*CAUSES, *RACE, "terminated", "truncated"} < info.keys()


@OVER_IDS
def test_an_argument_of_none_is_the_ids_own(env_id):
    nothing = dict.fromkeys(ARGUMENTS)
    assert repr(make(env_id, **nothing)) == repr(make(env_id))
    without, default = (make(env_id, **arguments).default_params for arguments in (nothing, {}))
    chex.assert_trees_all_equal(without, default)


@OVER_IDS
def test_every_id_takes_a_plant_with_its_parameters_baked_in(env_id):
    class Baked(Coasting):
        dt = 0.01

    env = make(env_id, plant=Baked())
    assert env.name == env_id
    assert env.observation_space().shape == make(env_id).observation_space().shape
    assert not any(isinstance(layer, DomainRandomization) for layer in layers_of(env))


def test_overrides_reach_the_environment_which_says_what_it_is():
    env = gymnax.make("FlyTrackNoisy-v0", missed_gate="fly_on", track="split_s")[0]
    assert env.missed_gate == "fly_on"
    assert repr(env) == (
        "<FlyTrackNoisy-v0: track split_s, plant Simulator, effects none, observation size 29>"
    )
    stronger = nominal_parameters().with_effects(ThrustScale(1.1))
    assert "effects thrust_scale, " in repr(make("FlyTrack-v0", model=stronger))


WRONG_CALLS = {
    "env_id: found 'FlyTrack-v9', expected one of .*FlyTrack-v0": lambda: make("FlyTrack-v9"),
    "argument 'trak'; did you mean 'track'": lambda: gymnax.make(BASE, trak="split_s"),
    "argument 'wind'; expected one of track, .*reward": lambda: make(BASE, wind=3),
    "argument 'rende'; did you mean 'render_mode'": lambda: gymnasium.make(BASE, rende="human"),
    "argument 'reset_mode'; did you mean 'auto": lambda: gymnasium.make_vec(BASE, reset_mode=1),
    "key: found 0, expected a key of JAX, such as jax.random.key": lambda: make(BASE).reset(0),
    "key: found Array.*, expected a key of JAX": lambda: make(BASE).reset(jnp.zeros(2)),
    "key: found keys of shape .1,.*jax.vmap": lambda: make(BASE).reset(jax.random.key(0)[None]),
    r"plant: found str, expected a subclass of plants\.Plant": lambda: FlyTrack(plant="nominal"),
    "missed_gate: found 'ignore', expected one of": lambda: FlyTrack(missed_gate="ignore"),
    "reward: found 'speed', expected one of progress": lambda: FlyTrack(reward={"speed": 1.0}),
    r"reward\.progress: found 'much', expected": lambda: FlyTrack(reward={"progress": "much"}),
    "gymnax: found version 0.0.9, expected 1.0 or newer: pip": lambda: check_gymnax("0.0.9"),
}


@pytest.mark.parametrize("message", WRONG_CALLS)
def test_wrong_calls_are_refused_in_a_sentence_that_says_what_to_do(message):
    with pytest.raises((ValueError, TypeError, ImportError), match=message):
        WRONG_CALLS[message]()


SEABORN_WHERE_IT_DRAWS = """
import sys
import flytrack_env
from gymnax.environments.misc import pong
assert "seaborn" not in sys.modules
assert pong.sns.color_palette()
import seaborn
assert seaborn.color_palette is pong.sns.color_palette
"""


@pytest.mark.slow
def test_what_only_gymnaxs_pictures_need_is_imported_for_them():
    subprocess.run([sys.executable, "-c", SEABORN_WHERE_IT_DRAWS], check=True)


# --- Gradients ----------------------------------------------------------------------------------


@OVER_KINDS
def test_gradients_are_those_of_finite_differences_and_detached_unless_asked_for(env_id):
    """In float64, in the first of three actions and the first speed, away from every gate."""
    env, params = gymnax.make(env_id)
    attached = env.with_transition_gradients()
    assert attached.transition_gradients_enabled and not env.transition_gradients_enabled
    drone = drone_at((14.0, 12.0, 3.0), (3.0, -2.0, 1.0), applied=Action(0.1, -0.1, 0.2, 0.0))
    weights = np.random.default_rng(2).normal(size=env.observation_space(params).shape)

    def as_float64(leaf):
        return leaf.astype(float) if leaf.dtype == np.float32 else leaf

    def value(env, action_and_speed):
        action, speed = action_and_speed[:4], action_and_speed[4]
        moving = drone._replace(vel_w=drone.vel_w._replace(y=speed))
        state = jax.tree.map(as_float64, env.begin(moving, 0, params, jnp.uint32(11)))

        def advance(flown, command):
            observation, flown, reward, *_ = env.step_env(None, flown, command, params)
            return flown, (observation, env.transition_gradients_enabled * reward)

        commands = jnp.stack([action, jnp.full(4, 0.2), jnp.full(4, -0.1)])
        observations, rewards = jax.lax.scan(advance, state, commands)[1]
        return weights @ observations.sum(axis=0) + 10.0 * rewards.sum()

    with jax.enable_x64(True):
        start, shifts = np.array([0.2, -0.3, 0.1, 0.4, -2.0]), 1e-6 * np.eye(5)
        detached = quick_jit(jax.grad(partial(value, env)))(start)
        evaluate = quick_jit(jax.value_and_grad(partial(value, attached)))
        gradient = evaluate(start)[1]
        numeric = [(evaluate(start + s)[0] - evaluate(start - s)[0]) / 2e-6 for s in shifts]
    assert not np.asarray(detached).any() and np.abs(numeric).min() > 1e-6
    assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-5)
