"""What Gymnasium's environments compile once for all resets, and what a long run or odd actions meet."""

from typing import Any

import gymnasium
import numpy as np
import pytest

from flytrack_env.dynamics import nominal_parameters
from tests.contract.test_gymnasium import BASE, make_vector


@pytest.mark.parametrize("overrides", [{"model": nominal_parameters()}, {"reward": {"gate_pass": 2.0}}])
def test_arguments_of_numbers_are_compiled_once(overrides: dict[str, Any]) -> None:
    """Also where a track is named in every reset, which compiled anew as often."""
    env, again = (gymnasium.make(BASE, **overrides).unwrapped for _ in range(2))
    programs = env._simulation.programs
    assert again._simulation.programs is programs
    for name in ("figure_eight", "flytrack"):  # of as many gates
        env.reset(options={"track": name})
        assert env._simulation.programs is programs and env._simulation.env.track.name == "flytrack"
    heavier = nominal_parameters()._replace(m=1.1)
    assert gymnasium.make(BASE, model=heavier).unwrapped._simulation.programs is not programs


def test_actions_beyond_float32_are_clipped_without_a_warning() -> None:
    for env in (gymnasium.make(BASE, disable_env_checker=True), make_vector()):
        env.reset(seed=0)
        found = env.step(np.full(env.action_space.shape, -1e300))[0]
        env.reset(seed=0)
        np.testing.assert_array_equal(found, env.step(np.full(env.action_space.shape, -1.0))[0])


def test_a_vector_environment_counts_steps_for_ever() -> None:
    env = make_vector()
    env.reset(seed=0)
    env._count = 2**32 - 1
    for _ in range(2):
        env.step(np.zeros(env.action_space.shape))
    assert env._count == 1
