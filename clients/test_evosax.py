"""evosax's own problem class, without an adapter."""

from typing import Any

import jax
import numpy as np
import pytest

from clients import evosax_es
from flytrack_env.registration import ENVIRONMENTS

POPULATION_SIZE = 16


def test_evolution_improves_on_its_own_first_evaluation() -> None:
    outcome = evosax_es.measure(seed=0)
    assert outcome.return_gain >= evosax_es.RETURN_MARGIN, outcome
    assert outcome.gate_gain >= evosax_es.GATE_MARGIN, outcome


@pytest.mark.parametrize("env_id", sorted(ENVIRONMENTS))
def test_a_population_is_evaluated_on_every_id(env_id: str) -> None:
    problem = evosax_es.make_problem(env_id)

    def evaluate(key: jax.Array) -> Any:
        population = jax.vmap(problem.sample)(jax.random.split(key, POPULATION_SIZE))
        return problem.eval(key, population, problem.init(key))[:2]

    fitness, problem_state = jax.jit(evaluate)(jax.random.key(0))  # one compilation instead of three
    assert fitness.shape == (POPULATION_SIZE,)
    assert np.isfinite(fitness).all() and len(np.unique(fitness)) > POPULATION_SIZE // 2
    assert np.isfinite(problem_state.obs_mean).all() and (np.asarray(problem_state.obs_std) > 0).any()
