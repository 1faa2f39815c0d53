"""The shipped champion is near the time-optimal lap on the black box; polishing speeds one up."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from baselines.purejaxrl_ppo import load_checkpoint
from baselines.purejaxrl_ppo.checkpoint_env import draw_plants, plant_env, simulated_env
from baselines.purejaxrl_ppo.flights import race_many, score, start_keys
from baselines.purejaxrl_ppo.networks import Policy
from baselines.purejaxrl_ppo.polish import (
    LostError,
    Settings,
    average_clipped,
    decay_gradient,
    polish,
)
from benchmarks.champion import CHAMPION, FOLDER, MODEL
from flytrack_env import load_model, make
from flytrack_env.model_file import model_from_json
from flytrack_env.motion import Motion
from flytrack_env.references import model_digest, shipped_reference

MAX_BYTES = 100_000
MAX_RATIO_ROBUST, MIN_SUCCESS_ROBUST = 1.1, 0.9  # of few plants
ROBUST = FOLDER / "robust.safetensors"
NUM_FLIGHTS, NUM_STEPS, NUM_LAPS = 32, 2500, 3
SHORT = Settings(updates=20, learning_rate=3e-4, flights=8, laps=1, slowest_lap_s=4.6)
OFF = 0.03  # of every weight: the champion flies on, slower


@pytest.mark.parametrize(
    ("name", "min_success", "max_ratio"),
    [
        ("champion", 1.0, 1.03),
        pytest.param("corners", 0.9, 1.25, marks=pytest.mark.slow),  # it sees by a camera
    ],
)
def test_shipped_policies_race_on_the_black_box_near_the_optimum(
    name, min_success, max_ratio, black_box
):
    policy = load_checkpoint(name)
    env = plant_env(policy, black_box)
    keys = start_keys(7, NUM_FLIGHTS)
    result = score(race_many(env, policy.policy, keys, NUM_STEPS, NUM_LAPS))
    optimum = shipped_reference("flytrack", "flying", "black_box")
    assert result.success >= min_success
    assert optimum.time_s < result.flying_lap_s <= max_ratio * optimum.time_s


def test_robust_champion_races_on_plants_that_it_has_not_met():
    champion = load_checkpoint(ROBUST)
    model = load_model(MODEL)
    env = make("FlyTrack-v0", model=model)
    keys, plants = start_keys(8, NUM_FLIGHTS), draw_plants(8, NUM_FLIGHTS, model)
    result = score(race_many(env, champion.policy, keys, NUM_STEPS, NUM_LAPS, models=plants.models))
    optimum = shipped_reference("flytrack", "flying", "black_box")
    assert result.success >= MIN_SUCCESS_ROBUST
    assert result.flying_lap_s <= MAX_RATIO_ROBUST * optimum.time_s


def test_champion_is_a_small_policy_of_the_model_of_its_reference():
    champion = load_checkpoint(CHAMPION)
    assert champion.training is None and CHAMPION.stat().st_size < MAX_BYTES
    reference = shipped_reference("flytrack", "flying", "black_box")
    models = (model_from_json(champion.meta["model"], "champion"), load_model(MODEL))
    assert {model_digest(model) for model in models} == {model_digest(reference.model)}


def first_lap_s(env, network, params):
    """Return the mean first lap; not a number unless every flight finishes it."""
    result = score(race_many(env, Policy(network, params), start_keys(5, 32), 700, 1))
    return result.first_lap_s if result.success == 1.0 else np.nan


@pytest.mark.slow
def test_a_policy_gets_faster_and_is_not_changed_itself():
    champion = load_checkpoint(CHAMPION)
    env, reports = simulated_env(champion), []
    slower = jax.tree.map(lambda leaf: leaf * (1.0 - OFF), champion.params)
    kept = jax.tree.map(np.array, slower)
    policy = Policy(champion.network, slower)
    polished = polish(env, policy, 0, SHORT, report=lambda *counts: reports.append(counts))
    before, after = (first_lap_s(env, champion.network, params) for params in (slower, polished))
    assert after < before - 0.005
    jax.tree.map(np.testing.assert_array_equal, slower, kept)
    assert reports[-1] == (SHORT.updates, SHORT.updates)


@pytest.mark.slow
def test_polishing_is_about_as_fast_under_continuous_motion():
    """XLA computed what one step passes back to the one before many times over: 26 times slower."""
    champion = load_checkpoint(ROBUST)
    model, seconds = model_from_json(champion.meta["model"], "model"), {}
    for motion in (Motion.EULER, Motion.CONTINUOUS):
        env, ends = make("FlyTrack-v0", model=model._replace(motion=motion)), []
        few = SHORT._replace(updates=4)
        note = lambda *_, ends=ends: ends.append(time.process_time())  # noqa: E731
        polish(env, champion.policy, 0, few, report=note)
        seconds[motion] = min(np.diff(ends))
    assert seconds[Motion.CONTINUOUS] < 4.0 * seconds[Motion.EULER], seconds


def test_a_policy_that_does_not_race_is_refused():
    champion = load_checkpoint(CHAMPION)
    lost = jax.tree.map(jnp.zeros_like, champion.params)
    with pytest.raises(
        ValueError, match=r"found none of 8 flights that passed 8 gates within 4\.6 s"
    ):
        polish(simulated_env(champion), Policy(champion.network, lost), 0, SHORT)


@pytest.mark.slow
def test_models_move_as_far_as_the_policy_follows():
    """With three times the mass nobody takes off, so that models go back and forth before that."""
    champion = load_checkpoint(CHAMPION)
    env, reports = simulated_env(champion), []
    model = env.default_params.model
    heavier = SHORT._replace(updates=1, curriculum_steps=10, curriculum_updates=12)
    with pytest.raises(LostError, match=r"followed \d+% of the way to other models in 12 updates"):
        polish(
            env,
            champion.policy,
            0,
            heavier,
            lambda key, way: model._replace(m=model.m * (1.0 + 2.0 * way)),
            lambda *counts: reports.append(counts),
        )
    to_do = [total - done for done, total in reports]
    changes = np.diff([11, *to_do])
    assert set(changes) == {-1, 1} and min(to_do) > 1, to_do


def test_one_flight_does_not_outweigh_the_others():
    flights = {"a": jnp.array([[0.3, 0.0], [3e5, 0.0]]), "b": jnp.array([[0.4], [-4e5]])}
    mean = average_clipped(flights, 1.0)
    np.testing.assert_allclose(mean["a"], [0.5 * (0.3 + 0.6), 0.0], rtol=1e-6)
    np.testing.assert_allclose(mean["b"], [0.5 * (0.4 - 0.8)], rtol=1e-6)


def test_a_decayed_state_is_the_same_with_less_gradient():
    tree = {"value": jnp.float32(3.0), "count": jnp.int32(2)}
    decayed = decay_gradient(tree, 0.9)
    assert float(decayed["value"]) == 3.0 and decayed["count"] is tree["count"]
    assert jax.grad(lambda x: decay_gradient(x, 0.9) ** 2)(3.0) == pytest.approx(0.9 * 6.0)
