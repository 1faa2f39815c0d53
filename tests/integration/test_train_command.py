"""The command of the training: its flags, what it resumes, what it refuses, and how it ends."""

import signal
from dataclasses import replace

import pytest

from baselines.purejaxrl_ppo import Config, load_checkpoint, train_ppo
from baselines.purejaxrl_ppo.checkpoint import save_checkpoint
from baselines.purejaxrl_ppo.config import RECIPES
from baselines.purejaxrl_ppo.train_ppo import make_trainer, parse
from baselines.purejaxrl_ppo.training import DEFAULT_OPTIONS, DivergedError, Stopped, Trainer
from tests.support.ppo_runs import CONFIG, ENV_ID, SEED
from tests.support.ppo_runs import make_trainer as make_shared_trainer
from tests.support.tables import table


def read(*arguments):
    return parse([*map(str, arguments)])


def call(*arguments):
    """Run the command; return its exit code."""
    with pytest.raises(SystemExit) as caught:
        train_ppo.main([*map(str, arguments)])
    return caught.value.code


def test_flags_override_the_file_and_the_file_the_defaults(tmp_path):
    path = tmp_path / "run.toml"
    path.write_text("total_timesteps = 2e7\nlearning_rate = 1e-3\nhidden_sizes = [32, 32]\n")
    settings, *_ = read(
        "--config", path, "--learning-rate", 2e-3, "--no-affine-shuffle", "--num-envs", 512
    )
    expected = Config(
        20_000_000, 512, learning_rate=2e-3, hidden_sizes=(32, 32), affine_shuffle=False
    )
    assert settings.hyperparameters == expected
    settings, *_ = read(
        "--total-timesteps", "4e6", "--hidden-sizes", 8, 8, "--reward", "progress=2"
    )
    assert settings.hyperparameters == Config(4_000_000, hidden_sizes=(8, 8))
    assert train_ppo.parse_rewards(settings.reward) == {"progress": 2.0}


def test_a_device_chooses_the_recipe(monkeypatch, whole):
    assert read("--device", "cpu")[0].hyperparameters == Config()
    monkeypatch.setattr(train_ppo.jax, "default_backend", lambda: "gpu")
    settings, *_ = read("--device", "gpu", "--num-minibatches", 64)
    assert settings.hyperparameters == replace(RECIPES["gpu"], num_minibatches=64)
    assert read("--device", "gpu", "--resume", whole[0])[0].hyperparameters == CONFIG


@pytest.mark.parametrize(("arguments", "message"), table("resumed")["flags"])
def test_what_does_not_fit_a_run_is_refused(
    whole, tmp_path, monkeypatch, capsys, arguments, message
):
    monkeypatch.chdir(tmp_path)
    assert call("--no-tracking", "--resume", whole[0], *arguments, "--out", "out") == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_resuming_takes_from_the_checkpoint_what_is_not_given(whole):
    settings, start, _ = read("--resume", whole[0], "--evaluate-every", 5)
    assert settings.hyperparameters == CONFIG and settings.env_id == ENV_ID
    assert (settings.seed, start.path) == (SEED, whole[0] / "final.safetensors")
    assert settings.run.evaluate_every == 5
    assert settings.run.checkpoint_every == DEFAULT_OPTIONS.checkpoint_every
    start.meta["environment"]["reward.off_centre"] = -0.25
    assert make_trainer(settings, start).env.default_params.reward.off_centre == -0.25


@pytest.mark.parametrize(("changes", "message"), table("resumed")["changes"])
def test_a_checkpoint_that_cannot_be_resumed_is_named(whole, tmp_path, changes, message):
    path = tmp_path / "final.safetensors"
    old = load_checkpoint(whole[0] / "final.safetensors")
    save_checkpoint(path, old.params, old.config, {**old.meta, **changes}, old.training)
    with pytest.raises(ValueError, match=f"{path}: {message}"):
        make_trainer(*read("--resume", path, "--no-tracking"))


@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (DivergedError("training diverged"), 1, "flytrack train: error: training diverged\n"),
        (OSError(28, "No space left on device", "a.safetensors"), 1, "device: 'a.safetensors'\n"),
        (ValueError("out holds a run"), 2, "flytrack train: error: out holds a run\n"),
        (Stopped("stopped by SIGINT", signal.SIGINT), 130, "stopped by SIGINT\n"),
    ],
)
def test_exit_codes_and_messages(tmp_path, monkeypatch, capsys, error, status, text):
    def fail(self, *arguments):
        raise error

    monkeypatch.setattr(Trainer, "train", fail)
    monkeypatch.setattr(train_ppo, "make_trainer", lambda *_: make_shared_trainer())
    assert call("--out", tmp_path, "--no-tracking") == status
    assert capsys.readouterr().err.endswith(text)
