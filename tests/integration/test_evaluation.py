"""Evaluation: single flights and many agree, lap times, drawn plants, report, and refusals."""

import importlib.util
import json

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from baselines.purejaxrl_ppo import checkpoint_env, evaluate
from baselines.purejaxrl_ppo import flights as flights_module
from baselines.purejaxrl_ppo.checkpoint import load_checkpoint
from baselines.purejaxrl_ppo.flights import fly_many, race_many, score, start_keys
from baselines.purejaxrl_ppo.report import summarize_plants
from flytrack_env import FlyTrack, make, nominal_parameters
from flytrack_env.effects import CommandDelay, LinearDrag, QuadraticDrag, ThrustScale
from flytrack_env.references import shipped_reference
from flytrack_env.rollout import load_rollout
from flytrack_env.state import BATTERY, POSITION
from flytrack_env.wrappers import DomainRandomization
from flytrack_env.wrappers.domain_randomization import sample_model
from tests.support.evaluated import FAILS_BELOW_V, Rails, write_checkpoint
from tests.support.recordings import Recording
from tests.support.refusals import run
from tests.support.slow import slow_but

NUM_LAPS, NUM_STEPS, NUM_FLIGHTS = 3, 1400, 10
TOLERANCE_S = 2e-3


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoint")
    return load_checkpoint(write_checkpoint(folder / "policy.safetensors"))


@pytest.fixture(scope="module")
def on_rails():
    return FlyTrack(plant=Rails())


@pytest.fixture(scope="module")
def flights(on_rails, checkpoint):
    return fly_many(on_rails, checkpoint.policy, 0, NUM_FLIGHTS, NUM_STEPS, NUM_LAPS)


@pytest.fixture(scope="module")
def raced(on_rails, checkpoint):
    """The same flights, in batches, the last one not full."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(flights_module, "BATCH", 4)
        return race_many(
            on_rails, checkpoint.policy, start_keys(0, NUM_FLIGHTS), NUM_STEPS, NUM_LAPS
        )


def test_lap_times_are_those_of_the_rails(flights, raced):
    battery_v = np.asarray(flights.states)[:, 0, BATTERY]
    paces = np.where(
        battery_v < FAILS_BELOW_V, 0.0, Rails.pace(battery_v)
    )  # 0 where a flight falls
    is_good = paces > 0.0
    assert 0 < is_good.sum() < NUM_FLIGHTS  # else this test would see one kind only
    assert_array_equal(raced.is_complete(), is_good)
    assert_array_equal(raced.ends()["ground"], ~is_good)
    standing, flying = (shipped_reference("flytrack", kind) for kind in ("standing", "flying"))
    expected = paces[is_good, None] * np.array([[standing.time_s, flying.time_s, flying.time_s]])
    assert_allclose(raced.lap_times_s[is_good], expected, atol=TOLERANCE_S)
    gates_s = paces[is_good, None] * standing.gate_times_s
    assert_allclose(raced.gate_times_s[is_good, :8], gates_s, atol=TOLERANCE_S)
    assert np.isnan(raced.lap_times_s[~is_good]).all() and (raced.steps[~is_good] < 210).all()
    assert score(raced).success == is_good.mean()


def test_every_step_kept_or_not_is_the_same_flight(flights, raced):
    assert NUM_FLIGHTS % 4
    chex.assert_trees_all_close(raced, flights.outcome, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("flown_by", slow_but(["black box"], ["black box", "plants"]))
def test_command_flies_many(flown_by, checkpoint, tmp_path, monkeypatch, capsys, request):
    outcomes = []

    def race(*given):
        outcomes.append(race_many(*given))
        return outcomes[0]

    monkeypatch.setattr(evaluate, "race_many", race)
    more = ["--episodes", 2, "--plants", 3]
    if flown_by == "black box":
        more = ["--episodes", 6, "--laps", 1]
        flights = request.getfixturevalue("flights")  # one program less to compile
        first = jax.tree.map(lambda leaf: leaf[0], flights)
        monkeypatch.setattr(evaluate.Report, "_fly_first", lambda *_: first)
    out, file = tmp_path / "flight.npy", tmp_path / "new" / "report.json"
    where = ["--checkpoint", checkpoint.path, "--out", out, "--json", file]
    run("eval", *where, "--steps", 120, "--track", "split_s", "--ghost", *more)
    steps, report, text = outcomes[0].steps, json.loads(file.read_text()), capsys.readouterr().out
    assert report["flights"] == report["success"]["of"] == 6 and report["track"] == "split_s"
    assert report["schema"] == 1 and report["steps"] == steps.sum()
    assert f"complete {report['laps']} laps: 0 of 6" in text
    num_states = len(load_rollout(out)[0])
    assert num_states == report["first_flight"]["steps"] == len(load_rollout(report["ghost"])[0])
    if flown_by == "plants":
        assert steps[0] == num_states and len(set(steps[::2].tolist())) > 1  # the plants differ
        assert report["black_box"] is None and report["optimal"]["model"] == "nominal"
        assert report["success"]["low"] is None and len(report["plants"]["by_thirds"]) == 12
        assert report["plants"]["success"]["of"] == 3
    else:
        assert report["optimal"]["model"] == "black_box" and report["plants"] is None
        # Wilson's interval, of none of 6.
        assert report["success"]["high"] == pytest.approx(0.390334, abs=1e-5)


def test_a_single_flight_is_reported_and_recorded(
    checkpoint, tmp_path, monkeypatch, capsys, flights, raced
):
    index = int(np.argmax(raced.is_complete()))
    flight = jax.tree.map(lambda leaf: leaf[index], flights)
    monkeypatch.setattr(evaluate.Report, "_fly_first", lambda *_: flight)
    out, file, recording = (tmp_path / name for name in ("f.npy", "report.json", "f.rrd"))
    has_rerun = importlib.util.find_spec("rerun") is not None
    where = ["--out", out, "--json", file, *["--rrd", recording] * has_rerun]
    run("eval", "--checkpoint", checkpoint.path, "--steps", NUM_STEPS, *where)
    text, report = capsys.readouterr().out, json.loads(file.read_text())
    if has_rerun:
        assert report["recording"] == str(recording)
        recorded = Recording(recording)
        for drone in ("/world/drone", "/world/flights/simulator/drone"):
            positions = recorded.series(drone, "Transform3D:translation")
            assert_allclose(positions, load_rollout(out)[0][:, POSITION])
    assert "interval" not in text and report["success"] is None and report["ghost"] is None
    lap_times_s = report["first_flight"]["lap_times_s"]
    assert_allclose(lap_times_s, raced.lap_times_s[index], atol=1e-5)
    starts = ("flown:", "gates:", "lap times:", "ended:")
    assert all(map(str.startswith, text.splitlines(), starts))


def test_plants_are_drawn_from_the_ranges_around_the_model():
    known = (LinearDrag(0.4, 0.4, 0.2), CommandDelay(0.03), ThrustScale(0.9))
    model = nominal_parameters().with_effects(*known, QuadraticDrag(0.01, shared=0.0))
    models, drawn = checkpoint_env.draw_plants(3, 200, model)
    for name, (low, high) in checkpoint_env.RANGES.items():
        assert low <= drawn[name].min() and drawn[name].max() <= high
        assert np.ptp(drawn[name]) > 0.5 * (high - low)
    delay, drag = models.effect("command_delay"), models.effect("quadratic_drag")
    wind = models.effect("wind")
    assert_allclose(models.effect("thrust_scale").factor, 0.9 * drawn["thrust_scale"], 1e-6)
    assert_allclose(models.effect("linear_drag").d_x, np.float32(0.4))
    assert_allclose(delay.delay_s, 0.03 + drawn["command_delay_s"], 1e-6)
    assert drag.k_x.min() >= 0.01 and (drag.shared == 0.0).all()
    assert_allclose(np.hypot(wind.v_x, wind.v_y), drawn["wind_m_s"], atol=1e-6)
    assert (wind.v_x < 0).any() and (wind.v_y < 0).any() and not np.any(wind.v_z)
    fewer, another = (checkpoint_env.draw_plants(seed, 5, model).drawn for seed in (3, 4))
    assert_array_equal(fewer["wind_m_s"], drawn["wind_m_s"][:5])
    assert not np.array_equal(another["wind_m_s"], fewer["wind_m_s"])


def test_what_breaks_the_policy_shows_in_its_thirds():
    drawn = checkpoint_env.draw_plants(0, 90, nominal_parameters()).drawn
    is_good = drawn["command_delay_s"] < np.quantile(drawn["command_delay_s"], 2.0 / 3.0)
    rows = summarize_plants(drawn, np.stack([is_good, np.ones(90, bool)], axis=1))["by_thirds"]
    shares = {name: [] for name in drawn}
    for row in rows:
        shares[row["quantity"]].append((row["plants"]["share"], row["flights_share"]))
    assert shares.pop("command_delay_s") == [(1.0, 1.0), (1.0, 1.0), (0.0, 0.5)]
    assert len(rows) == 12 and all(min(share)[0] > 0.3 for share in shares.values())
    assert len(summarize_plants({"wind_m_s": np.ones(1)}, np.ones((1, 1), bool))["by_thirds"]) == 1


def test_ids_that_draw_models_fly_the_one_that_is_given(checkpoint):
    env = checkpoint_env.simulated_env(checkpoint)
    params = checkpoint_env.with_model_as_given(env.default_params)
    env.check_params(params)
    ranges, given = params.wrappers[DomainRandomization.key], env.default_params.model
    drawn = sample_model(jnp.uint32(5), given, ranges)
    assert type(drawn.effects[0]) is LinearDrag and len(drawn.effects) == 1
    chex.assert_trees_all_close(
        drawn._replace(tau=np.stack(drawn.tau)), given, rtol=1e-6, atol=1e-6
    )
    plain = make("FlyTrackNoisy-v0").default_params
    assert checkpoint_env.with_model_as_given(plain) is plain
