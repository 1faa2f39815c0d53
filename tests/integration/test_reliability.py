"""The soak of the simulation: it finds planted faults, and a small share of it holds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.reliability import simulation
from flytrack_env import FlyTrack
from flytrack_env.params import RANGES


class Faulty(FlyTrack):
    """An environment with infinite rewards, crooked attitudes and observations that are not numbers."""

    def advance(self, state, command, params):
        state, reward, terminated, info = super().advance(state, command, params)
        drone = state.plant.drone
        crooked = drone._replace(quat=jax.tree.map(lambda q: 1.001 * q, drone.quat))
        return state._replace(plant=state.plant._replace(drone=crooked)), reward + jnp.inf, terminated, info

    def observe_drone(self, drone, state, params):
        return [jnp.nan * row for row in super().observe_drone(drone, state, params)]


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulation, "NUM_ENVS", 64)
    monkeypatch.setattr(simulation, "NUM_STEPS", 40)


@pytest.mark.slow
def test_faults_are_found(few: None) -> None:
    env = Faulty()
    found = simulation.fly(env, jax.random.key(0), env.default_params, False)
    seen = {name for name in simulation.VIOLATIONS if found[name]}
    reward, attitude, observation = (simulation.VIOLATIONS[index] for index in (1, 3, 4))
    assert seen == {reward, attitude, observation, "info not finite"}  # which holds the final observation


@pytest.mark.slow
@pytest.mark.parametrize("name", simulation.extreme_environments())
def test_extremes_hold(few: None, name: str) -> None:
    env = simulation.extreme_environments()[name]
    params = simulation.draw_extremes(np.random.default_rng(0), env.default_params)
    env.check_params(params)
    assert params.model.m.max() == np.float32(RANGES["model.m"].high)
    found = simulation.fly(env, jax.random.key(0), params, True)
    assert found["episodes"] > 0 and not any(found[violation] for violation in simulation.VIOLATIONS)
