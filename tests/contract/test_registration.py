"""Registration with gymnax: ids, overrides, and importing the package more than once."""

import importlib
from typing import Any

import gymnax
import jax
import pytest
from gymnax.registration import registered_envs

import flytrack_env
from flytrack_env.registration import ENVIRONMENTS, make, register_all
from flytrack_env.wrappers import DomainRandomization, layers_of


@pytest.mark.parametrize("env_id", sorted(ENVIRONMENTS))
def test_every_id_is_made_twice_and_after_another_import(env_id: str) -> None:
    first, first_params = gymnax.make(env_id)
    importlib.reload(flytrack_env)
    register_all()
    second, second_params = gymnax.make(env_id)
    assert first is not second
    assert list(registered_envs).count(env_id) == 1
    assert type(first) is type(second)
    assert jax.tree.structure(first_params) == jax.tree.structure(second_params)


@pytest.mark.parametrize("env_id", sorted(ENVIRONMENTS))
def test_every_id_resets_and_steps(env_id: str) -> None:
    env, params = gymnax.make(env_id)
    key = jax.random.key(0)
    observation, state = jax.eval_shape(env.reset, key, params)
    action = jax.eval_shape(env.action_space(params).sample, key)
    outputs = jax.eval_shape(env.step, key, state, action, params)
    assert len(outputs) == 6
    assert outputs[0].shape == observation.shape == env.observation_space(params).shape
    assert jax.tree.structure(outputs[1]) == jax.tree.structure(state)


def test_flytrack_is_registered_under_its_name() -> None:
    assert "FlyTrack-v0" in ENVIRONMENTS
    assert gymnax.make("FlyTrack-v0")[0].name == "FlyTrack-v0"


def test_overrides_reach_the_environment() -> None:
    assert make("FlyTrack-v0", missed_gate="fly_on").missed_gate == "fly_on"
    assert gymnax.make("FlyTrack-v0", missed_gate="fly_on")[0].missed_gate == "fly_on"
    with pytest.raises(ValueError, match="missed_gate"):
        gymnax.make("FlyTrack-v0", missed_gate="sometimes")


@pytest.mark.parametrize("env_id", sorted(ENVIRONMENTS))
def test_every_id_takes_a_plant_with_its_parameters_baked_in(env_id: str, coasting: Any) -> None:
    class Baked(type(coasting)):
        dt = 0.01

    env = make(env_id, plant=Baked())
    assert env.name == env_id
    assert env.observation_space().shape == make(env_id).observation_space().shape
    assert not any(isinstance(layer, DomainRandomization) for layer in layers_of(env))


def test_unknown_ids_are_refused() -> None:
    with pytest.raises(ValueError, match=r"env_id: found 'FlyTrack-v9', expected one of .*FlyTrack-v0"):
        make("FlyTrack-v9")
