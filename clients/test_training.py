"""Every client learns on FlyTrack-v0, and runs on every id."""

from types import ModuleType
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from torchrl.envs import GymEnv, GymWrapper

from clients import evosax_es, rejax_ppo
from clients.measure import CLIENTS
from flytrack_env.registration import ENVIRONMENTS

POPULATION_SIZE = 16

every_id = pytest.mark.parametrize("env_id", sorted(ENVIRONMENTS))


@pytest.mark.parametrize("client", CLIENTS.values(), ids=CLIENTS)
def test_training_gains_its_margins(client: ModuleType) -> None:
    outcome = client.measure(seed=0)
    assert outcome.has_gained(client.RETURN_MARGIN, client.GATE_MARGIN), outcome


def test_torchrl_wraps_single_and_vector_environments() -> None:
    envs = gymnasium.make_vec("flytrack_env:FlyTrack-v0", 8, autoreset_mode="SameStep")
    for env, shape in ((GymEnv("FlyTrack-v0"), (300,)), (GymWrapper(envs), (8, 300))):
        flown = env.rollout(300, break_when_any_done=False)
        assert flown["next", "done"].any() and flown["next", "observation"].isfinite().all()
        assert flown.shape == shape


@every_id
def test_rejax_can_be_traced(env_id: str) -> None:
    ppo = rejax_ppo.make_ppo(env_id)
    train_state, (lengths, returns) = jax.eval_shape(ppo.train, jax.random.key(0))
    assert lengths.shape == returns.shape == (5, 128)
    observation_shape = ppo.env.observation_space(ppo.env_params).shape
    assert train_state.last_obs.shape == (ppo.num_envs, *observation_shape)


@every_id
def test_evosax_evaluates_a_population(env_id: str) -> None:
    problem = evosax_es.make_problem(env_id)

    def evaluate(key: jax.Array) -> Any:
        population = jax.vmap(problem.sample)(jax.random.split(key, POPULATION_SIZE))
        return problem.eval(key, population, problem.init(key))[:2]

    fitness, problem_state = jax.jit(evaluate)(
        jax.random.key(0)
    )  # one compilation instead of three
    assert fitness.shape == (POPULATION_SIZE,)
    assert np.isfinite(fitness).all() and len(np.unique(fitness)) > POPULATION_SIZE // 2
    assert (
        np.isfinite(problem_state.obs_mean).all() and (np.asarray(problem_state.obs_std) > 0).any()
    )
