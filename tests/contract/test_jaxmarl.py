"""JaxMARL races our drones: what its own tests ask of an environment, and its wrapper."""

import chex
import jax
import jax.numpy as jnp
from jaxmarl.environments import MultiAgentEnv
from jaxmarl.environments.spaces import Space
from jaxmarl.wrappers.baselines import LogWrapper

import flytrack_env
from flytrack_env.multi_drone.jaxmarl_api import JaxMarlRace
from tests.support.compiling import quick_jit

AGENTS = ("drone_0", "drone_1")
RACE = flytrack_env.make_race("FlyTrackRace-v0", len(AGENTS))


def test_it_is_an_environment_of_jaxmarl_that_resets_to_the_state_that_is_given():
    params = JaxMarlRace(RACE).params
    flight = params.flight.replace(max_steps_in_episode=1)
    env = JaxMarlRace(RACE, params._replace(flight=flight))
    assert isinstance(env, MultiAgentEnv) and len(env.agents) == env.num_agents == len(AGENTS)
    actions = dict.fromkeys(AGENTS, jnp.zeros(4))
    reset, step = quick_jit(env.reset), quick_jit(env.step)
    (observations, first), (_, given) = (reset(jax.random.key(seed)) for seed in (0, 1))
    again = env.get_obs(first)
    after, state, rewards, dones, infos = step(jax.random.key(2), first, actions, given)
    for agent in AGENTS:
        assert isinstance(env.observation_space(agent), Space)
        assert env.action_space(agent).contains(env.action_space(agent).sample(jax.random.key(1)))
        assert jnp.allclose(again[agent], observations[agent], atol=2e-5)
        assert env.observation_space(agent).contains(observations[agent])
        assert env.observation_space(agent).contains(after[agent])
    assert set(rewards) == set(AGENTS) and set(dones) == {*AGENTS, "__all__"}
    assert infos["rank"].shape == (2,) and env.get_avail_actions(first)["drone_0"].all()
    assert dones["__all__"]
    chex.assert_trees_all_equal(state, given)
    logging = LogWrapper(env)
    state = jax.eval_shape(logging.reset, jax.random.key(0))[1]
    info = jax.eval_shape(logging.step, jax.random.key(1), state, actions)[-1]
    assert info["returned_episode_lengths"].shape == (2,)
