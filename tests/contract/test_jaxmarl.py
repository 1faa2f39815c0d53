"""JaxMARL races our drones: what its own tests ask of an environment, and its wrapper."""

import chex
import jax
import jax.numpy as jnp
import pytest
from jaxmarl.environments import MultiAgentEnv
from jaxmarl.environments.spaces import Space
from jaxmarl.wrappers.baselines import LogWrapper

import flytrack_env
from flytrack_env.multi_drone.jaxmarl_api import JaxMarlRace
from tests.support.compiling import quick_jit

ENV = JaxMarlRace(flytrack_env.make_race("FlyTrackRace-v0", 3))


def short_race():
    """Return races of one step, and actions of all drones."""
    params = ENV.params._replace(flight=ENV.params.flight.replace(max_steps_in_episode=1))
    return JaxMarlRace(ENV.race, params), {agent: jnp.zeros(4) for agent in ENV.agents}


def test_it_is_an_environment_of_jaxmarl():
    """A race that is over is reset to the state that is given."""
    assert isinstance(ENV, MultiAgentEnv) and len(ENV.agents) == ENV.num_agents == 3
    env, actions = short_race()
    (observations, first), (_, given) = (env.reset(jax.random.key(seed)) for seed in (0, 1))
    again = env.get_obs(first)
    step = quick_jit(env.step)
    after, state, rewards, dones, infos = step(jax.random.key(2), first, actions, given)
    for agent in env.agents:
        assert isinstance(env.observation_space(agent), Space)
        assert env.action_space(agent).contains(env.action_space(agent).sample(jax.random.key(1)))
        assert jnp.allclose(again[agent], observations[agent], atol=2e-5)
        assert env.observation_space(agent).contains(observations[agent])
        assert env.observation_space(agent).contains(after[agent])
    assert set(rewards) == set(env.agents) and set(dones) == {*env.agents, "__all__"}
    assert infos["rank"].shape == (3,) and env.get_avail_actions(first)["drone_0"].all()
    assert dones["__all__"]
    chex.assert_trees_all_equal(state, given)


@pytest.mark.slow  # it compiles a step with auto-reset
def test_jaxmarls_wrapper_logs_returns_of_episodes():
    env, actions = short_race()
    env = LogWrapper(env)
    _, state = env.reset(jax.random.key(0))
    *_, dones, info = env.step(jax.random.key(1), state, actions)
    assert dones["__all__"] and (info["returned_episode_lengths"] == 1).all()
