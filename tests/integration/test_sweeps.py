"""Sweeps: which spaces are accepted, and a local one of two trials, each an MLflow run below the sweep's."""

import os
import subprocess
import sys

import pytest

from baselines.purejaxrl_ppo import load_checkpoint
from baselines.purejaxrl_ppo.config import ConfigError
from baselines.purejaxrl_ppo.sweeps.__main__ import parse, prepare
from baselines.purejaxrl_ppo.sweeps.space import read_space
from tests.support.pages import ROOT

BATCH = 16 * 24
SMALL = ("--num-envs", 16, "--num-steps", 24, "--num-minibatches", 4, "--hidden-sizes", 8)
GRID = "[learning_rate]\ngrid_search = [1e-3, 2e-3]\n"


def written(folder, text):
    path = folder / "space.toml"
    path.write_text(text)
    return path


def test_a_space_is_read_and_drawn_from(tmp_path):
    text = "[learning_rate]\nloguniform = [1e-4, 1e-2]\n[hidden_sizes]\nchoice = [[8], [64, 64]]\n"
    drawn = read_space(written(tmp_path, text + "[num_steps]\ngrid_search = [32, 64.0]\n"))
    assert drawn["hidden_sizes"].categories == [(8,), (64, 64)]
    assert drawn["num_steps"] == {"grid_search": [32, 64]}
    rates = [drawn["learning_rate"].sample() for _ in range(100)]
    assert 1e-4 <= min(rates) < 1e-3 < max(rates) <= 1e-2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "found no setting"),
        ("learning_rate", "not a TOML file"),
        ("[speed]\nchoice = [1]", "speed: unknown; expected one of total_timesteps"),
        ("learning_rate = 3", "learning_rate: found 3, expected one of choice"),
        ("[learning_rate]\nuniform = [1]", r"uniform: found \[1.0\]: .*missing"),
        ("[learning_rate]\nchoice = ['a']", "found 'a', expected a finite number"),
    ],
)
def test_a_space_that_cannot_be_used_is_refused(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message) as error:
        read_space(written(tmp_path, text))
    assert "space.toml" in str(error.value)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--learning-rate", "0.1"], "learning_rate: drawn by"),
        (["--trials", "0"], "--trials: found 0"),
        (["--num-minibatches", "3"], "num_minibatches"),
        (["--out", "."], "expected a new folder or an empty one"),
    ],
)
def test_what_no_trial_could_use_is_refused_before_any(tmp_path, monkeypatch, flags, message):
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, GRID)
    with pytest.raises(ValueError, match=message):
        prepare(parse([str(path), "--out", "out", *flags]))


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # deprecations in MLflow's own dependencies
def test_a_local_sweep(tmp_path):
    from mlflow import MlflowClient

    out = tmp_path / "sweep"
    flags = ("--trials", 1, "--out", out, "--total-timesteps", 2 * BATCH, *SMALL)
    command = (sys.executable, "-m", "baselines.purejaxrl_ppo.sweeps", written(tmp_path, GRID), *flags)
    # Ray's processes are nice, and get next to nothing beside another worker of these tests.
    environment = {**os.environ, "RAY_worker_niceness": "0"}
    done = subprocess.run(
        [*map(str, command)], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=500
    )
    assert done.returncode == 0, done.stderr
    assert "best: " in done.stdout and "config/learning_rate" in done.stdout
    table = (out / "sweep.csv").read_text()
    assert "evaluation_success" in table.splitlines()[0] and len(table.splitlines()) == 3
    rates = [load_checkpoint(out / f"trial{n}" / "final.safetensors").config.learning_rate for n in (0, 1)]
    assert sorted(rates) == [1e-3, 2e-3]
    client = MlflowClient(tracking_uri=f"sqlite:///{out / 'mlflow.db'}")
    runs = client.search_runs([client.get_experiment_by_name("flytrack").experiment_id])
    (whole,) = [run for run in runs if "mlflow.parentRunId" not in run.data.tags]
    parts = [run for run in runs if run.data.tags.get("mlflow.parentRunId") == whole.info.run_id]
    assert len(runs) == 3 and len(parts) == 2
    assert {run.info.status for run in runs} == {"FINISHED"}
    assert sorted(run.data.params["config.learning_rate"] for run in parts) == ["0.001", "0.002"]
