"""Sweeps: which spaces are taken, and a local one of four trials, each an MLflow run below the sweep's."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from baselines.purejaxrl_ppo.journal import JournalError
from baselines.purejaxrl_ppo.sweeps.results import Trial, draw, in_order, table, write_results

from baselines.purejaxrl_ppo import Config, load_checkpoint
from baselines.purejaxrl_ppo.config import ConfigError
from baselines.purejaxrl_ppo.sweeps.__main__ import make_parser, prepare
from baselines.purejaxrl_ppo.sweeps.space import for_tune, points_of, read_space
from baselines.purejaxrl_ppo.tracking import Tracker, send_journal

ROOT = Path(__file__).parents[2]
BATCH = 16 * 24
SMALL = ("--num-envs", 16, "--num-steps", 24, "--num-minibatches", 4, "--hidden-sizes", 8)
quiet_mlflow = pytest.mark.filterwarnings("default")  # its own dependencies' deprecations
GRID = "[learning_rate]\ngrid_search = [1e-3, 2e-3]\n"


def written(folder, text):
    path = folder / "space.toml"
    path.write_text(text)
    return path


def test_a_space_is_read_and_drawn_from(tmp_path):
    text = "[learning_rate]\nloguniform = [1e-4, 1e-2]\n[hidden_sizes]\nchoice = [[8], [64, 64]]\n"
    space = read_space(written(tmp_path, text + "[num_steps]\ngrid_search = [32, 64.0]\n"))
    assert space["hidden_sizes"]["choice"] == [(8,), (64, 64)] and space["num_steps"]["grid_search"] == [
        32,
        64,
    ]
    assert points_of(space) == 2 and points_of({}) == 1
    drawn = for_tune(space)
    assert drawn["num_steps"] == {"grid_search": [32, 64]}
    rates = [drawn["learning_rate"].sample() for _ in range(100)]
    assert 1e-4 <= min(rates) < 1e-3 < max(rates) <= 1e-2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "found no setting"),
        ("learning_rate", "cannot be read"),
        ("[" * 100_000, "cannot be read"),
        ("[speed]\nchoice = [1]", "speed: unknown; expected one of total_timesteps"),
        ("learning_rate = 3", "learning_rate: found 3, expected one of choice"),
        ("[learning_rate]\nnormal = [0, 1]", "expected one of choice"),
        ("[learning_rate]\nchoice = [1]\nuniform = [1, 2]", "expected one of choice"),
        ("[learning_rate]\nuniform = [1]", r"found \[1\], expected lower, upper"),
        ("[learning_rate]\nquniform = [1, 2]", "expected lower, upper, q"),
        ("[learning_rate]\nuniform = [2, 1]", "expected the smaller one first"),
        ("[learning_rate]\nchoice = ['a']", "found 'a', expected a finite number"),
        ("[learning_rate]\nchoice = 3", "found 3, expected a list of values"),
        ("[hidden_sizes]\nuniform = [[8], [9]]", "expected one of choice, grid_search: it is no number"),
    ],
)
def test_a_space_that_cannot_be_used_is_refused(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message) as error:
        read_space(written(tmp_path, text))
    assert "space.toml" in str(error.value)


def test_what_no_trial_could_use_is_refused_before_any(tmp_path):
    path = written(tmp_path, GRID)

    def refused(*flags):
        arguments = make_parser().parse_args([str(path), "--out", str(tmp_path / "out"), *flags])
        with pytest.raises(ValueError) as error:
            prepare(arguments)
        return str(error.value)

    assert "learning_rate: drawn by" in refused("--learning-rate", "0.1")
    assert "--trials: found 0" in refused("--trials", "0")
    assert "expected one of" in refused("--env-id", "FlyTrack-v9")
    assert "num_minibatches" in refused("--num-minibatches", "3")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "file").touch()
    assert "expected a new folder or an empty one" in refused()


def test_the_best_trial_is_the_first():
    def trial(number, success, lap_s=None, error=None):
        evaluation = {} if success is None else {"evaluation_success": success}
        laps = {} if lap_s is None else {"evaluation_flying_lap_s": lap_s}
        return Trial(Path(f"trial{number}"), {"learning_rate": 1e-3 * 9**number}, evaluation | laps, error)

    trials = [trial(0, 0.5, 4.0), trial(1, 1.0, 5.0), trial(2, None, error="diverged"), trial(3, 1.0, 4.5)]
    assert [one.folder.name for one in in_order(trials)] == ["trial3", "trial1", "trial0", "trial2"]
    lines = table(trials).splitlines()
    assert lines[0] == "trial3: success 100.0%, flying lap 4.500 s; learning_rate 0.729"
    assert lines[3] == "trial2: diverged; learning_rate 0.081"
    assert draw(trials).axes[0].get_xscale() == "log"


def test_results_are_a_table_and_a_picture(tmp_path):
    trials = [Trial(tmp_path / "trial0", {"affine_shuffle": True, "num_steps": 64}, {}, None)]
    table_path, picture = write_results(tmp_path, trials)
    assert json.loads(table_path.read_text())[0]["settings"] == {"affine_shuffle": True, "num_steps": 64}
    assert picture.read_bytes().startswith(b"\x89PNG")


@quiet_mlflow
def test_a_part_is_not_sent_before_the_whole(tmp_path):
    part = Tracker(tmp_path / "trial0", "sqlite:///none.db", "part", {}, parent=tmp_path)
    Tracker(tmp_path, "sqlite:///none.db", "whole", {})
    with pytest.raises(JournalError, match="upload it first"):
        send_journal(part.journal, f"sqlite:///{tmp_path}/store.db")


@quiet_mlflow
def test_a_local_sweep_of_four_trials(tmp_path):
    from mlflow import MlflowClient

    out = tmp_path / "sweep"
    flags = ("--trials", 2, "--out", out, "--total-timesteps", 2 * BATCH, *SMALL)
    command = (sys.executable, "-m", "baselines.purejaxrl_ppo.sweeps", written(tmp_path, GRID), *flags)
    # Ray's processes are nice, and get next to nothing beside another worker of these tests.
    environment = {**os.environ, "RAY_worker_niceness": "0"}
    done = subprocess.run(
        [*map(str, command)], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=500
    )
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 4 and "failed" not in done.stdout
    assert "4/4" in done.stderr and "Warning" not in done.stderr
    results = json.loads((out / "sweep.json").read_text())
    rates = {one["folder"]: one["settings"]["learning_rate"] for one in results}
    assert sorted(rates.values()) == [1e-3, 1e-3, 2e-3, 2e-3]
    for folder, rate in rates.items():
        assert load_checkpoint(out / folder / "final.safetensors").config.learning_rate == rate
    assert all("evaluation_success" in one["evaluation"] and one["error"] is None for one in results)
    assert (out / "sweep.png").exists()
    client = MlflowClient(tracking_uri=f"sqlite:///{out / 'mlflow.db'}")
    runs = client.search_runs([client.get_experiment_by_name("flytrack").experiment_id])
    (whole,) = [run for run in runs if "mlflow.parentRunId" not in run.data.tags]
    parts = [run for run in runs if run.data.tags.get("mlflow.parentRunId") == whole.info.run_id]
    assert len(runs) == 5 and len(parts) == 4
    assert {run.info.status for run in runs} == {"FINISHED"}
    assert sorted(run.data.params["config.learning_rate"] for run in parts) == ["0.001"] * 2 + ["0.002"] * 2
    assert Config().learning_rate not in rates.values()
