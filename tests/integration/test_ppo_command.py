"""The command of the training: what it takes up again, of which seeds, and how it ends."""

import re
import shutil
import sys

import pytest
from baselines.purejaxrl_ppo.options import OPTIONS, read_options, write_options

from baselines.purejaxrl_ppo import load_checkpoint, tracking, train_ppo
from baselines.purejaxrl_ppo import plans as plans_module
from baselines.purejaxrl_ppo.checkpoint import save_checkpoint
from baselines.purejaxrl_ppo.resume import check_same_run, describe_run, newest_intact, seeds_in
from baselines.purejaxrl_ppo.run import DivergedError
from baselines.purejaxrl_ppo.training import Options
from tests.support.ppo_runs import CONFIG, DEAD_URI, EVERY_OTHER_UPDATE, SEED, make_trainer


def parse(*arguments):
    return train_ppo.make_parser().parse_args([*map(str, arguments)])


def call(monkeypatch, *arguments):
    """Run the command; return its exit code."""
    monkeypatch.setattr(sys, "argv", ["train_ppo", *map(str, arguments)])
    with pytest.raises(SystemExit) as caught:
        train_ppo.main()
    return caught.value.code


@pytest.fixture(scope="module")
def cut_off(tmp_path_factory):
    """A folder of seeds 3, complete, and 4, of which only the options are there."""
    out = tmp_path_factory.mktemp("seeds")
    make_trainer().train(out / "seed3", SEED, EVERY_OTHER_UPDATE)
    options = Options(5, None, 7, tracking.local_uri(out))
    for seed in (3, 4):
        write_options(out / f"seed{seed}", options)
    (out / tracking.LOCAL_STORE).touch()
    return out


def test_a_resumed_run_goes_on_with_its_options(cut_off, tmp_path):
    moved = tmp_path / "moved"
    shutil.copytree(cut_off, moved)
    for source in (moved, moved / "seed3", moved / "seed3" / "step_0.msgpack"):
        arguments = parse("--resume", source)
        plans = plans_module.make_plans(arguments)
        for plan, options in zip(plans, plans_module.options_of(arguments, plans), strict=True):
            assert options == Options(5, None, 7, tracking.local_uri(moved), plan.resume)
    arguments = parse("--resume", moved / "seed3", "--no-tracking", "--checkpoint-every", 0)
    plans = plans_module.make_plans(arguments)
    (options,) = plans_module.options_of(arguments, plans)
    assert options == Options(None, None, 7, None, plans[0].resume)
    for content in ('{"checkpoint_every": "often"}', "[" * 100_000):
        (moved / "seed3" / OPTIONS).write_text(content)
        with pytest.raises(ValueError, match=r"options\.json: damaged"):
            plans_module.options_of(arguments, plans)


def test_a_store_elsewhere_is_found_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for uri, expected in (
        ("sqlite:///store/all.db", f"sqlite:///{tmp_path}/store/all.db"),
        ("http://server:5000", "http://server:5000"),
        (None, None),
    ):
        write_options(tmp_path / "run", Options(tracking_uri=uri))
        (tmp_path / "run").rename(tmp_path / "moved")
        assert read_options(tmp_path / "moved") == Options(tracking_uri=expected)
        shutil.rmtree(tmp_path / "moved")


def test_seeds_are_those_of_the_folder(cut_off, tmp_path):
    def seeds(*arguments):
        return [plan.seed for plan in plans_module.make_plans(parse("--resume", *arguments))]

    assert seeds(cut_off) == [3, 4]
    assert seeds(cut_off, "--num-seeds", 3) == [3, 4, 5]
    assert seeds(cut_off, "--seed", 3) == [3]
    for arguments, message in (
        ([cut_off, "--seed", 8, "--num-seeds", 2], r"no checkpoint of seeds \[8, 9\].*holds seeds \[3, 4\]"),
        ([cut_off / "seed3", "--num-seeds", 2], "checkpoints of one run: leave out --num-seeds"),
    ):
        with pytest.raises(ValueError, match=message):
            seeds(*arguments)
    with pytest.raises(ValueError, match="runs of several seeds, expected that of one: seed3, seed4"):
        newest_intact(cut_off)
    for arguments in (["--num-seeds", 2, "--seed", 3], []):
        with pytest.raises(ValueError, match=f"--resume (it|{cut_off})[,)]"):
            plans_module.make_plans(parse("--out", cut_off, *arguments))


def test_every_checkpoint_is_checked_before_any_training(cut_off, tmp_path):
    shutil.copytree(cut_off, tmp_path / "seeds")
    shutil.copytree(cut_off / "seed3", tmp_path / "seeds" / "seed5")
    with pytest.raises(ValueError, match=r"seed5.*: does not fit: seed: found 3, expected 5"):
        train_ppo.prepare(parse("--resume", tmp_path / "seeds"))
    shutil.copytree(cut_off / "seed3", tmp_path / "other")
    with pytest.raises(ValueError, match="other holds the checkpoints of a run"):
        train_ppo.prepare(parse("--resume", cut_off / "seed3", "--out", tmp_path / "other"))


def test_seeds_that_have_not_begun_are_in_the_folder(tmp_path, monkeypatch, capsys):
    def interrupt(self, asked):
        self.steps = 40
        if is_checkpointed:
            (asked[0][0] / "step_0.msgpack").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr(train_ppo.Trainer, "train_all", interrupt)
    is_checkpointed = False
    assert call(monkeypatch, "--out", tmp_path / "out", "--num-seeds", 3, "--seed", 5) == 130
    assert capsys.readouterr().err == "stopped at 40 steps, before the first checkpoint\n"
    assert seeds_in(tmp_path / "out") == [5, 6, 7]
    is_checkpointed = True
    assert call(monkeypatch, "--out", tmp_path / "one") == 130
    assert capsys.readouterr().err == f"stopped at 40 steps; go on with --resume {tmp_path / 'one'}\n"


def test_only_errors_of_arguments_show_the_usage(tmp_path, monkeypatch, capsys):
    def diverge(self, asked):
        raise DivergedError("training diverged")

    monkeypatch.setattr(train_ppo.Trainer, "train_all", diverge)
    assert call(monkeypatch, "--out", tmp_path) == 1
    assert capsys.readouterr().err == "train_ppo: error: training diverged\n"
    assert call(monkeypatch, "--out", tmp_path, "--no-tracking", "--tracking-uri", DEAD_URI) == 2
    usage, error = capsys.readouterr().err.splitlines()
    assert usage == "usage: train_ppo [options]" and "not allowed with" in error


# What is taken from the checkpoint.


def plans_of(*arguments):
    return train_ppo.make_plans(parse(*arguments))


def test_resuming_takes_from_the_checkpoint_what_is_not_given(whole, tmp_path):
    arguments = train_ppo.make_parser().parse_args(["--resume", str(whole[0])])
    (plan,) = train_ppo.make_plans(arguments)
    assert (plan.seed, plan.out, plan.resume) == (SEED, whole[0], whole[0] / "final.safetensors")
    found = train_ppo.make_trainer(arguments, plan)
    assert found.config == CONFIG and found.env_id == "FlyTrackRobust-v0"
    check_same_run(
        plan.resume,
        plan.checkpoint,
        describe_run(found.env, found.env_id, found.track, found.config, plan.seed),
    )
    assert plans_of("--resume", whole[0], "--out", tmp_path)[0].out == tmp_path
    steps = plan.checkpoint.meta["steps"]
    assert train_ppo.say_resumed(plan) == f"seed {SEED}: from step {steps}, {whole[0] / 'final.safetensors'}"
    assert train_ppo.say_resumed(plan._replace(resume=None, checkpoint=None)) is None


def test_resuming_keeps_the_reward_that_was_trained_for(whole):
    (plan,) = plans_of("--resume", whole[0])
    plan.checkpoint.meta["environment"]["reward.off_centre"] = -0.25
    kept = train_ppo.make_trainer(parse("--resume", "x"), plan)
    asked = train_ppo.make_trainer(parse("--reward", "off_centre=-0.5"), plan)
    assert kept.env.default_params.reward.off_centre == -0.25
    assert asked.env.default_params.reward.off_centre == -0.5


def write_changed(source, path, **changes):
    """Write a checkpoint whose description says something else."""
    checkpoint = load_checkpoint(source)
    meta = {**checkpoint.meta, **changes}
    save_checkpoint(path, checkpoint.params, checkpoint.config, meta, checkpoint.training)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"environment": {"reward.gate_pass": "a lot"}}, "environment: found .*numbers for weights"),
        ({"environment": {"reward.beauty": 1.0}}, "with its settings and the flags: .*beauty"),
        ({"env_id": "Hover-v0"}, "with its settings and the flags: env_id: found 'Hover-v0'"),
        ({"track": "/nowhere/track.toml"}, "with its settings and the flags: .*track.toml"),
        ({"missed_gate": "sometimes"}, "with its settings and the flags: .*'sometimes'"),
        ({"model": {"m": "heavy"}}, "with its settings and the flags: model: "),
    ],
)
def test_settings_of_a_checkpoint_that_cannot_be_used_are_told_with_its_name(
    whole, tmp_path, changes, message
):
    path = tmp_path / "final.safetensors"
    write_changed(whole[0] / "final.safetensors", path, **changes)
    with pytest.raises(ValueError, match=f"{path}: {message}"):
        train_ppo.prepare(parse("--resume", path, "--no-tracking"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--learning-rate", "0.1"], r"config\.learning_rate: found 0\.003, expected 0\.1$"),
        (["--seed", "4"], r"seed: found 3, expected 4$"),
        (["--track", "split_s"], r"track_data\.name: found 'flytrack', expected 'split_s'"),
    ],
)
def test_resuming_with_other_settings_is_refused(whole, tmp_path, arguments, message, monkeypatch, capsys):
    common = ["--resume", str(whole[0]), "--no-tracking", "--out", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", ["train_ppo", *common, *arguments])
    with pytest.raises(SystemExit):
        train_ppo.main()
    assert re.search(message, capsys.readouterr().err.strip())
    assert not (tmp_path / "out").exists()


def test_every_seed_of_several_has_its_folder(whole, tmp_path):
    shutil.copytree(whole[0], tmp_path / "seed1")
    plans = plans_of("--seed", 0, "--num-seeds", 2, "--resume", tmp_path)
    assert [(plan.seed, plan.out, plan.resume) for plan in plans] == [
        (0, tmp_path / "seed0", None),
        (1, tmp_path / "seed1", tmp_path / "seed1" / "final.safetensors"),
    ]
    with pytest.raises(ValueError, match="seed1 holds the checkpoints of a run"):
        plans_of("--num-seeds", 2, "--out", tmp_path)
    with pytest.raises(ValueError, match="holds the checkpoints of a run"):
        plans_of("--out", whole[0])
    with pytest.raises(ValueError, match=r"--resume: found .*final\.msgpack, expected the folder"):
        plans_of("--num-seeds", 2, "--resume", whole[0] / "final.safetensors")
    with pytest.raises(ValueError, match="--num-seeds: found 0"):
        plans_of("--num-seeds", 0)
