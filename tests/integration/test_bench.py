"""The benchmark protocol: frozen tasks, results that repeat, and what is refused."""

import json

import chex
import numpy as np
import pytest
from numpy.testing import assert_allclose

from baselines.purejaxrl_ppo import load_checkpoint
from benchmarks import suite as drawn
from benchmarks.champion import CHAMPION
from flytrack_bench import Data, DataError, cli, load_policy, load_suite, results, retrain
from flytrack_bench.policies import Function, Policy, PolicyError
from flytrack_bench.suite import FOLDER, digest_of
from flytrack_env.jobs import ClusterError, Outcome
from flytrack_env.tracks import load_track
from flytrack_loop.adapt import Adapted
from tests.support.refusals import refused, run
from tests.support.small_suite import CENTRED, hover, write_small_suite


@pytest.fixture
def small(tmp_path):
    """The file of a suite of two tasks with two starts each."""
    return write_small_suite(tmp_path / "small.json")


def test_the_suite_is_what_its_seed_draws(tmp_path):
    """Up to the last digits, which differ between processors, and so do the digests."""
    drawn.draw_suite(tmp_path)
    for name in drawn.TRACK_SEEDS:
        rows = [load_track(folder / "v1" / f"{name}.toml").rows() for folder in (tmp_path, FOLDER)]
        assert_allclose(*rows, rtol=1e-12, atol=1e-12)
    drawn_tasks, tasks = (
        json.loads((folder / "v1.json").read_text())["tasks"] for folder in (tmp_path, FOLDER)
    )
    for drawn_task, task in zip(drawn_tasks, tasks, strict=True):
        assert all(drawn_task[name] == task[name] for name in ("id", "track", "optimal_lap_s"))
        chex.assert_trees_all_close(drawn_task["craft"], task["craft"], rtol=1e-14)
    suite = load_suite("v1")
    assert sum(task.craft is not None for task in suite.tasks) == 8 and len(suite.tasks) == 12


@pytest.mark.slow
def test_a_result_repeats_and_is_verified_and_a_forged_one_is_not(small, tmp_path, capsys):
    out, command = tmp_path / "result.json", ["bench", "--policy", CENTRED, "--suite", small]
    run(*command, "--out", out)
    result = json.loads(out.read_text())
    assert all(
        flight["success"] == 0.0 for flights in result["tasks"].values() for flight in flights
    )
    run(*command, "--verify", out)
    result["tasks"]["flytrack"][0] |= {"success": 1.0, "flying_lap_s": 3.9}
    out.write_text(json.dumps(result))
    with pytest.raises(SystemExit, match="1"):
        run(*command, "--verify", out)
    assert "flytrack, policy 0" in capsys.readouterr().out
    refused(capsys, *command, "--out", out)  # never overwritten


def test_a_cluster_is_given_whole_paths(small, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.safetensors").touch()
    sent = []

    def run_jobs(function, jobs, limit_s, address):
        sent.extend(flags for flags, _ in jobs.values())
        yield "flytrack", Outcome(None, "no")

    monkeypatch.setattr(cli, "run_jobs", run_jobs)
    flags = cli.Flags(("own.safetensors", "champion", CENTRED), suite="small.json", address="auto")
    with pytest.raises(ClusterError, match="task flytrack: no"):
        cli.fly_on_cluster(flags, load_suite(small), [], ["flytrack"])
    assert sent[0].policy == (str(tmp_path / "own.safetensors"), "champion", CENTRED)
    assert sent[0].suite == str(tmp_path / "small.json")


def test_a_changed_suite_is_refused(small):
    content = json.loads(small.read_text()) | {"starts": 1}
    small.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="digest"):
        load_suite(small)
    content["tasks"][0]["track"] = "speedway"
    content["digest"] = digest_of(content)
    small.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="the track was changed"):
        load_suite(small)


def test_all_data_and_no_more_are_flown_and_a_checkpoint_is_adapted_to_them(small, monkeypatch):
    suite, robust = load_suite(small), load_policy("robust")
    logs = []

    def note(log, checkpoint):
        logs.append(log)
        return Adapted(None, checkpoint, False)

    monkeypatch.setattr(retrain, "adapt", note)
    data = Data(suite.tasks[1], suite, seconds=0.6)
    with pytest.raises(DataError, match=r"found 0.7, expected at most the 0.6 s left"):
        data.fly(robust, 0.7)
    adapted = retrain.adapt_to_flight(data, robust)
    (log,) = logs
    assert 55 <= len(log) <= 60 and log.time.max() < 0.6  # some rows are lost, as sensors lose them
    assert data.seconds_left == 0.0
    assert adapted.checkpoint is robust.checkpoint and adapted.name == "robust, adapted"
    with pytest.raises(PolicyError, match="found hover, expected a checkpoint"):
        retrain.adapt_to_flight(data, Policy("hover", Function(hover), None, None, ""))


def test_the_interval_covers_the_spread_of_seeds():
    flown = {str(task): [{"score": value} for value in row] for task, row in enumerate(SPREAD)}
    summary = results.summary(flown, "score")
    assert summary["interquartile_mean"] == pytest.approx(
        np.sort(SPREAD, axis=None)[3:9].mean(), abs=1e-6
    )
    low, high = summary["ci95"]
    assert low < summary["interquartile_mean"] < high and 0.02 < high - low < 0.2
    assert results.summary({"one": [{"score": 0.5}]}, "score")["ci95"] is None


SPREAD = np.array([[0.1, 0.2, 0.15], [0.5, 0.55, 0.6], [0.5, 0.4, 0.45], [0.9, 1.0, 0.95]])


@pytest.mark.slow
def test_a_policy_is_trained_again_on_the_model_of_the_plant_that_was_diagnosed(small, monkeypatch):
    suite, champion = load_suite(small), load_policy(str(CHAMPION))
    trained = []

    def train(out, config, seed, model):
        trained.append(model)
        return load_checkpoint(CHAMPION), {}

    monkeypatch.setattr(retrain, "train_policy", train)
    task = suite.tasks[1]
    data = Data(task, suite, seconds=20.0)
    policy = retrain.diagnose_and_retrain(data, champion)
    assert data.seconds_left == 0.0 and policy.checkpoint is not None
    (model,) = trained
    assert_allclose(model.tau[:3], task.craft.tau[:3], atol=0.005)
