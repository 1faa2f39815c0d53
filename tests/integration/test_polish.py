"""Polishing: the gradient of the race time through the simulator makes a policy faster."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from baselines.purejaxrl_ppo import load_checkpoint
from baselines.purejaxrl_ppo.flights import race_many, score, start_keys
from baselines.purejaxrl_ppo.polish import Settings, decayed, polish
from baselines.purejaxrl_ppo.race_env import simulated_env
from benchmarks.champion import CHAMPION

SHORT = Settings(updates=20, learning_rate=3e-4, flights=8, laps=1, slowest_lap_s=4.6)
OFF = 0.03  # of every weight: the champion flies on, slower


def first_lap_s(env, network, params):
    """Return the mean first lap; not a number unless every flight finishes it."""
    result = score(race_many(env, network, params, start_keys(5, 32), 700, 1))
    return result.first_lap_s if result.success == 1.0 else np.nan


def test_a_policy_gets_faster_and_is_not_changed_itself():
    champion = load_checkpoint(CHAMPION)
    env, reports = simulated_env(champion), []
    slower = jax.tree.map(lambda leaf: leaf * (1.0 - OFF), champion.params)
    kept = jax.tree.map(np.array, slower)
    found = polish(env, champion.network, slower, 0, SHORT, report=lambda *counts: reports.append(counts))
    before, after = (first_lap_s(env, champion.network, params) for params in (slower, found))
    assert after < before - 0.005
    jax.tree.map(np.testing.assert_array_equal, slower, kept)
    assert reports[-1] == (SHORT.updates, SHORT.updates)


def test_a_policy_that_does_not_race_is_refused():
    champion = load_checkpoint(CHAMPION)
    lost = jax.tree.map(jnp.zeros_like, champion.params)
    with pytest.raises(ValueError, match=r"found none of 8 flights that passed 8 gates within 4\.6 s"):
        polish(simulated_env(champion), champion.network, lost, 0, SHORT)


def test_a_decayed_state_is_the_same_with_less_gradient():
    tree = {"value": jnp.float32(3.0), "count": jnp.int32(2)}
    found = decayed(tree, 0.9)
    assert float(found["value"]) == 3.0 and found["count"] is tree["count"]
    assert jax.grad(lambda x: decayed(x, 0.9) ** 2)(3.0) == pytest.approx(0.9 * 6.0)
