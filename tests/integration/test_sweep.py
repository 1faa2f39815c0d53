"""Sweeps: which settings are accepted, and a sweep on this machine that is killed."""

import csv
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from baselines.purejaxrl_ppo import Config, load_checkpoint
from baselines.purejaxrl_ppo.config import ConfigError
from baselines.purejaxrl_ppo.sweep import (
    check_is_shared,
    make_scheduler,
    read_settings,
)

BATCH = 16 * 24
SMALL = f"total_timesteps = {64 * BATCH}\nnum_envs = 16\nnum_steps = 24\nhidden_sizes = [8]\n"
GRID = SMALL + "num_minibatches = 4\n[learning_rate]\ngrid_search = [1e-3, 3e-3]\n"


def written(folder, text):
    path = folder / "settings.toml"
    path.write_text(text)
    return path


def test_settings_are_fixed_or_drawn(tmp_path):
    text = "num_envs = 64\n[hidden_sizes]\nchoice = [[8], [64, 64]]\n[gamma]\nuniform = [0.9, 1]\n"
    config, space = read_settings(written(tmp_path, text))
    assert config.num_envs == 64
    drawn = "[gamma]\nquniform = [0.9, 1, 0.02]\n[num_envs]\nrandint = [1, 9]"
    assert read_settings(written(tmp_path, drawn))[1] == {
        "gamma": ("quniform", [0.9, 1.0, 0.02]),
        "num_envs": ("randint", [1, 9]),
    }
    assert space == {"hidden_sizes": ("choice", [(8,), (64, 64)]), "gamma": ("uniform", [0.9, 1.0])}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "found no setting that is drawn"),
        ("learning_rate", "cannot be read"),
        ("[speed]\nchoice = [1]", "speed: unknown; expected one of total_timesteps"),
        ("[gamma]\nguess = [1]", "gamma: found .*, expected one of choice, grid_search"),
        ("[gamma]\nuniform = [1]", "uniform: found .*, expected lowest and highest value"),
        ("[num_envs]\nuniform = [16, 64]", "expected randint or lograndint for this setting"),
        ("[gamma]\nrandint = [0, 2]", "expected uniform or the like"),
        ("[num_envs]\nrandint = [64, 16]", "expected lowest < highest"),
        ("[gamma]\nquniform = [0.9, 1]", "expected lowest and highest value, and a step"),
        ("[gamma]\nuniform = [0.9, 1.5]", "gamma"),
    ],
)
def test_settings_that_cannot_be_used_are_refused(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message) as error:
        read_settings(written(tmp_path, text))
    assert "settings.toml" in str(error.value)


def test_a_node_that_does_not_see_the_folder_says_so(tmp_path):
    (tmp_path / "tune").mkdir()
    check_is_shared(tmp_path)
    with pytest.raises(ConfigError, match=r"--out .*gone: found none on node .*all nodes see"):
        check_is_shared(tmp_path / "gone")


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # Ray's own
def test_asha_remembers_trials_of_before_an_interruption(tmp_path):
    from ray import cloudpickle

    config = Config()
    scheduler = make_scheduler(tmp_path / "asha.pkl", config)
    stored = cloudpickle.dumps(scheduler)  # as Ray stores it, before any result

    def result_of(scheduler, name, last_return, is_last=False):
        trial = SimpleNamespace(trial_id=name)
        scheduler.on_trial_add(None, trial)
        result = {"steps": config.total_timesteps // 8, "last_return": last_return}
        tell = scheduler.on_trial_complete if is_last else scheduler.on_trial_result
        return tell(None, trial, result)

    assert [result_of(scheduler, name, 0.0) for name in "ab"] == ["CONTINUE"] * 2
    result_of(scheduler, "c", 9.0, is_last=True)
    assert result_of(cloudpickle.loads(stored), "d", 1.0) == "STOP"
    (tmp_path / "asha.pkl").unlink()
    assert result_of(cloudpickle.loads(stored), "d", 1.0) == "CONTINUE"


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # deprecations in MLflow's own dependencies
def test_a_sweep_that_was_killed_goes_on(tmp_path):
    from mlflow import MlflowClient

    out = tmp_path / "sweep"
    command = [sys.executable, "-m", "flytrack", "sweep", str(written(tmp_path, GRID))]
    command += ["--trials", "1", "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as killed:
        deadline_s = time.monotonic() + 600.0
        while not list(out.glob("trial*/step_[1-9]*")):
            assert killed.poll() is None and time.monotonic() < deadline_s
            time.sleep(0.2)
        killed.kill()
    starts = [path.with_name("step_0.safetensors") for path in out.glob("trial*/step_[1-9]*")]
    stored = {path: path.stat().st_mtime_ns for path in starts}
    refused = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert "found a sweep: --resume goes on with it" in refused.stderr
    command += ["--resume"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr
    assert "best: " in done.stdout
    assert {path: path.stat().st_mtime_ns for path in stored} == stored, "a trial began anew"
    rows = list(csv.DictReader((out / "sweep.csv").read_text().splitlines()))
    folders = sorted(out.glob("trial*"))
    assert len(rows) == len(folders) == 2
    complete = [load_checkpoint(path).steps for path in out.glob("trial*/final.safetensors")]
    assert complete == [64 * BATCH] * len(complete)
    stopped = [row for row in rows if row["done"] == "True"]  # by ASHA
    assert len(complete) + len(stopped) == 2
    paths = [next(iter(sorted(folder.glob("step_0*")))) for folder in folders]
    assert sorted(load_checkpoint(path).config.learning_rate for path in paths) == [1e-3, 3e-3]
    client = MlflowClient(tracking_uri=f"sqlite:///{out / 'mlflow.db'}")
    runs = client.search_runs([client.get_experiment_by_name("flytrack").experiment_id])
    (sweep,) = [run for run in runs if "mlflow.parentRunId" not in run.data.tags]
    trials = [run for run in runs if run is not sweep]
    assert {run.data.tags["mlflow.parentRunId"] for run in trials} == {sweep.info.run_id}
    assert sorted(run.data.params["config.learning_rate"] for run in trials) == ["0.001", "0.003"]
    assert {run.info.status for run in runs} <= {"FINISHED", "KILLED"}
