"""The shipped champion: a policy alone that races on the shipped black box near the time-optimal lap."""

from baselines.purejaxrl_ppo import load_checkpoint
from baselines.purejaxrl_ppo.flights import race_many, score, start_keys
from baselines.purejaxrl_ppo.plants import draw_plants
from baselines.purejaxrl_ppo.race_env import plant_env
from benchmarks.champion import CHAMPION, FOLDER, MODEL
from flytrack_env import blackbox, load_model, make
from flytrack_env.model_file import model_from_json
from flytrack_env.references import model_digest, shipped_reference

MOST_BYTES = 100_000
MOST_TIMES, MOST_TIMES_ROBUST, LEAST_ROBUST = 1.03, 1.1, 0.9  # the optimum; of few plants
ROBUST = FOLDER / "robust.safetensors"
NUM_FLIGHTS, NUM_STEPS, NUM_LAPS = 32, 2500, 3


def test_champion_races_on_the_black_box_near_the_optimum():
    champion = load_checkpoint(CHAMPION)
    env = plant_env(champion, blackbox.load(blackbox.SHIPPED))
    keys = start_keys(7, NUM_FLIGHTS)
    result = score(race_many(env, champion.network, champion.params, keys, NUM_STEPS, NUM_LAPS))
    optimum = shipped_reference("flytrack", "flying", "black_box")
    assert result.success == 1.0
    assert optimum.time_s < result.flying_lap_s <= MOST_TIMES * optimum.time_s


def test_robust_champion_races_on_plants_that_it_has_not_met():
    champion = load_checkpoint(ROBUST)
    model = load_model(MODEL)
    env = make("FlyTrack-v0", model=model)
    keys, plants = start_keys(8, NUM_FLIGHTS), draw_plants(8, NUM_FLIGHTS, model)
    flown = race_many(env, champion.network, champion.params, keys, NUM_STEPS, NUM_LAPS, models=plants.models)
    result = score(flown)
    optimum = shipped_reference("flytrack", "flying", "black_box")
    assert result.success >= LEAST_ROBUST
    assert result.flying_lap_s <= MOST_TIMES_ROBUST * optimum.time_s


def test_champion_is_a_small_policy_of_the_model_of_its_reference():
    champion = load_checkpoint(CHAMPION)
    assert champion.training is None and CHAMPION.stat().st_size < MOST_BYTES
    model = model_from_json(champion.meta["model"], "champion")
    assert model_digest(model) == model_digest(load_model(MODEL))
    assert model_digest(model) == model_digest(shipped_reference("flytrack", "flying", "black_box").model)
