"""The command of the training: its flags, what it resumes, what it refuses, and how it ends."""

import shutil

import pytest

from baselines.purejaxrl_ppo import Config, load_checkpoint, tracking, train_ppo
from baselines.purejaxrl_ppo.checkpoint import save_checkpoint
from baselines.purejaxrl_ppo.train_ppo import make_plan, make_tasks, parse
from baselines.purejaxrl_ppo.training import DivergedError, Options, Trainer
from tests.support.ppo_runs import CONFIG, EVERY_OTHER_UPDATE, SEED, make_trainer

SEEDS = (SEED, SEED + 1)


def read(*arguments):
    return parse([*map(str, arguments)])


def tasks_of(*arguments):
    return [task for group in make_tasks(*read(*arguments)) for task in group]


def call(*arguments):
    """Run the command; return its exit code."""
    with pytest.raises(SystemExit) as caught:
        train_ppo.main([*map(str, arguments)])
    return caught.value.code


def test_flags_override_the_file_and_the_file_the_defaults(tmp_path):
    path = tmp_path / "run.toml"
    path.write_text("total_timesteps = 2e7\nlearning_rate = 1e-3\nhidden_sizes = [32, 32]\n")
    settings, _ = read("--config", path, "--learning-rate", 2e-3, "--no-affine-shuffle", "--num-envs", 512)
    expected = Config(20_000_000, 512, learning_rate=2e-3, hidden_sizes=(32, 32), affine_shuffle=False)
    assert settings.hyperparameters == expected
    settings, _ = read("--total-timesteps", "4e6", "--hidden-sizes", 8, 8, "--reward", "progress=2")
    assert settings.hyperparameters == Config(4_000_000, hidden_sizes=(8, 8))
    assert train_ppo.parse_rewards(settings.reward) == {"progress": 2.0}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--learning-rate", "0.1"], "config.learning_rate: found 0.003, expected 0.1\n"),
        (["--track", "split_s"], "track_data.name: found 'flytrack', expected 'split_s'"),
        (["--num-seeds", "2"], "leave out --seed and --num-seeds"),
    ],
)
def test_what_does_not_fit_a_run_is_refused(whole, tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert call("--no-tracking", "--resume", whole[0], *arguments, "--out", "out") == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_resuming_takes_from_the_checkpoint_what_is_not_given(whole, tmp_path):
    settings, resumed = read("--resume", whole[0])
    assert settings.hyperparameters == CONFIG and settings.env_id == "FlyTrackRobust-v0"
    ((task,),) = make_tasks(settings, resumed)
    assert (task.seed, task.out, task.start.path) == (SEED, whole[0], whole[0] / "final.safetensors")
    assert task.options == EVERY_OTHER_UPDATE._replace(seeds=(SEED,))
    uri = tracking.local_uri(tmp_path)
    elsewhere = ("--tracking-uri", "local", "--out", tmp_path)
    (task,) = tasks_of("--resume", whole[0], "--checkpoint-every", 0, *elsewhere)
    assert task.options == Options(tracking_uri=uri, seeds=(SEED,)) and task.out == tmp_path
    resumed.first.meta["environment"]["reward.off_centre"] = -0.25
    found = train_ppo.make_trainer(settings, resumed)
    assert found.env.default_params.reward.off_centre == -0.25


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"environment": {"reward.gate_pass": "a lot"}}, "environment: gate_pass: found 'a lot'"),
        ({"env_id": "Hover-v0"}, "with its settings and the flags: env_id: found 'Hover-v0'"),
        ({"options": {"evaluate_every": "often"}}, "options: .*"),
        ({"steps": 5}, "steps: found 5"),
    ],
)
def test_a_checkpoint_that_cannot_be_resumed_is_named(whole, tmp_path, changes, message):
    path = tmp_path / "final.safetensors"
    old = load_checkpoint(whole[0] / "final.safetensors")
    save_checkpoint(path, old.params, old.config, {**old.meta, **changes}, old.training)
    with pytest.raises(ValueError, match=f"{path}: {message}"):
        make_plan(["--resume", str(path), "--no-tracking"])


@pytest.mark.slow
def test_a_folder_of_seeds_is_resumed_with_those_that_had_not_begun(tmp_path):
    """Of seed 3, which is complete, and of seed 4, which has not begun; in another folder by then."""
    options, moved = EVERY_OTHER_UPDATE._replace(evaluation_episodes=7, seeds=SEEDS), tmp_path / "moved"
    make_trainer().train(tmp_path / "here" / "seed3", SEED, options)
    (tmp_path / "here").rename(moved)
    first, second = tasks_of("--resume", moved)
    assert (first.seed, first.start.path) == (3, moved / "seed3" / "final.safetensors")
    assert (second.seed, second.out, second.start) == (4, moved / "seed4", None)
    assert first.options.evaluation_episodes == 7 and first.options.seeds == SEEDS
    with pytest.raises(ValueError, match="found the runs of several seeds"):
        make_trainer().train(tmp_path / "x", SEED, Options(resume=moved))
    for arguments in (["--num-seeds", 2, "--seed", 3], []):
        with pytest.raises(ValueError, match=r"moved(.seed3)? holds the checkpoints of a run"):
            make_plan([*map(str, ["--out", moved, "--no-tracking", *arguments])])
    shutil.copytree(moved / "seed3", moved / "seed4")
    with pytest.raises(ValueError, match=r"seed4.*: does not fit: seed: found 3, expected 4"):
        make_plan(["--resume", str(moved)])


def test_exit_codes_and_messages(tmp_path, monkeypatch, capsys):
    def stop(self, runs):
        self.steps = 40
        if error is KeyboardInterrupt:
            (runs[0].out).mkdir(parents=True)
            (runs[0].out / "step_0.safetensors").touch()
        raise error

    monkeypatch.setattr(Trainer, "run", stop)
    monkeypatch.setattr(train_ppo, "make_trainer", lambda *_: make_trainer())
    error, out = DivergedError("training diverged"), tmp_path / "out"
    assert call("--out", tmp_path, "--no-tracking") == 1
    assert capsys.readouterr().err == "flytrack train: error: training diverged\n"
    error = KeyboardInterrupt
    assert call("--out", out, "--num-seeds", 2) == 130
    assert capsys.readouterr().err == f"stopped at 40 steps; continue with --resume {out}\n"
