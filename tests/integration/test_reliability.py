"""The soak of the simulation: a small share of it holds."""

import jax
import numpy as np
import pytest

from benchmarks.reliability import simulation
from flytrack_env.params import RANGES


@pytest.mark.slow
@pytest.mark.parametrize("name", simulation.extreme_environments())
def test_extremes_hold(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(simulation, "NUM_ENVS", 64)
    monkeypatch.setattr(simulation, "NUM_STEPS", 40)
    env = simulation.extreme_environments()[name]
    params = simulation.draw_extremes(np.random.default_rng(0), env.default_params)
    env.check_params(params)
    assert params.model.m.max() == np.float32(RANGES["model.m"].high)
    found = simulation.fly(env, jax.random.key(0), params, True)
    assert found["episodes"] > 0 and not any(found[violation] for violation in simulation.VIOLATIONS)
