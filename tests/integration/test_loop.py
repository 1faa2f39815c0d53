"""The loop's parts: the log of a policy's flights, the gap, and refusals."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from baselines.purejaxrl_ppo import load_checkpoint
from baselines.purejaxrl_ppo.checkpoint_env import plant_env
from baselines.purejaxrl_ppo.flights import Score, fly_many
from benchmarks.adapt import SizedPlant, sized_battery
from benchmarks.champion import CHAMPION
from benchmarks.loop.plants import draw_plant
from flytrack.cli import main
from flytrack_bench import load_suite
from flytrack_bench.hidden import HiddenPlant
from flytrack_env import BatteryWarning, nominal_parameters
from flytrack_env.model_file import save_model
from flytrack_loop import Gap, fly_log, race
from flytrack_loop.stages import log_of_flights, measure_gap
from flytrack_sysid import save_log
from tests.support.handout_plant import states_of


@pytest.fixture(scope="module")
def champion():
    return load_checkpoint(CHAMPION)


@pytest.fixture(scope="module")
def flights(champion, black_box):
    return fly_many(plant_env(champion, black_box), champion.policy, 3, 4, 450, 1)


@pytest.fixture(scope="module")
def log(flights):
    return log_of_flights(flights, 0.01, 3, 11.0, 0.0)


def test_the_log_is_what_the_plant_did(log, fly_black_box):
    assert 11.0 <= len(log) * 0.01 < 11.0 + 4.5
    row = 200
    after = fly_black_box(states_of(log)[row].astype(np.float32), log["u"][row].astype(np.float32))
    assert_allclose(log["p"][row + 1], after[:3], atol=1e-5)
    assert_allclose(log["w"][row + 1], after[13:16], atol=1e-4)


def test_the_log_has_a_segment_per_flight_and_is_noisy_on_request(log, flights):
    starts = log["p"][log.is_start()]
    assert (
        len(starts) == len(np.unique(log.segment)) == 3
    )  # of four that were flown: 11 s are enough
    assert np.ptp(starts[:, 0]) > 0.01  # each flight from a start of its own
    noisy = log_of_flights(flights, 0.01, 3, 11.0, 1.0)
    assert "uprev" not in noisy and "f" in noisy and len(noisy) < len(log)


def test_flights_that_end_at_once_are_no_log(flights):
    short = flights._replace(is_flying=np.arange(450) < np.full((4, 1), 49))
    with pytest.raises(ValueError, match="found 4 flights of at most 49 steps, expected one of 50"):
        log_of_flights(short, 0.01, 3, 12.0, 0.0)


@pytest.mark.slow
def test_the_gap_is_between_the_plant_and_the_simulator_learnt_in(champion):
    lost = draw_plant(2, 0)
    assert set(lost.effects) == {"thrust_scale"} and lost.effects["thrust_scale"]["factor"] < 1.0
    gap = measure_gap(champion, HiddenPlant(lost), seed=1, episodes=8)
    assert gap.simulator.success == 1.0 > gap.plant.success


@pytest.mark.slow
def test_a_policy_that_crashes_on_a_hidden_plant_is_adapted_to_ten_seconds_of_it(tmp_path):
    """The plant has equations, battery and mass of its own; its log is that of common sensors."""
    hidden = load_suite("v1").chosen(("plant_1",))[0].craft
    plant, policy = SizedPlant(hidden, 16.8, 0.6), load_checkpoint("robust")
    known = nominal_parameters().resized(0.6, sized_battery(16.8))
    save_model(tmp_path / "craft.json", known, {})
    with pytest.warns(BatteryWarning, match="15.4 to 16.8 V"):
        log = fly_log(plant, policy, 3, 10.0, 1.0)
        old = race(policy, plant_env(policy, plant), 5, 64)
    save_log(tmp_path / "race.npz", log.select(np.arange(len(log)) < 1000))
    new = tmp_path / "new.safetensors"
    named = "--checkpoint", "robust", "--model", str(tmp_path / "craft.json"), "--out", str(new)
    main(["adapt", str(tmp_path / "race.npz"), *named])
    adapted = race(load_checkpoint(new), plant_env(load_checkpoint(new), plant), 5, 64)
    assert old.success < 0.1 and adapted.success > 0.9
    assert adapted.flying_lap_s < 3.6


def test_a_policy_without_laps_has_no_gap():
    crashed, flown = Score(0.0, 1.0, math.nan, math.nan), Score(1.0, 24.0, 4.0, 4.0)
    assert math.isnan(Gap(flown, crashed).lap_percent)
    assert Gap(flown, flown._replace(flying_lap_s=4.04)).lap_percent == pytest.approx(1.0)
