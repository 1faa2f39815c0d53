"""Training runs: resumed, extended, damaged, diverged, watched; the bits stay the same."""

import dataclasses
import logging
import os
import random
import shutil
import signal
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from baselines.purejaxrl_ppo import CheckpointError, load_checkpoint, monitor
from baselines.purejaxrl_ppo.checkpoint import (
    check_same_run,
    checkpoints_in,
    newest_intact,
    save_checkpoint,
)
from baselines.purejaxrl_ppo.training import DivergedError, Options, Run, Stopped, Trainer
from tests.support.pages import ROOT
from tests.support.ppo_runs import BATCH, CONFIG, ENV_ID, EVERY_OTHER_UPDATE, SEED, assert_same_end


def step_path(folder, updates):
    return folder / f"step_{updates * BATCH}.safetensors"


def test_checkpoints_are_written_at_the_steps_asked_for(whole):
    names = {"final.safetensors"} | {step_path(whole[0], updates).name for updates in (0, 2, 4, 6)}
    assert {path.name for path in whole[0].iterdir()} == names


def test_a_complete_run_is_left_alone_and_no_run_is_overwritten(trainer, whole, tmp_path):
    shutil.copytree(whole[0], tmp_path / "run")
    final = tmp_path / "run" / "final.safetensors"
    written = final.stat().st_mtime_ns
    assert trainer.train(final.parent, SEED, resume=final.parent)[1] == {}
    assert final.stat().st_mtime_ns == written
    for resume in (None, whole[0]):
        with pytest.raises(ValueError, match=r"run holds the checkpoints of a run.*--resume .*run"):
            trainer.train(final.parent, SEED, resume=resume)


def test_a_run_resumed_from_the_newest_intact_checkpoint_ends_bit_for_bit(
    trainer, whole, tmp_path, caplog
):
    shutil.copytree(whole[0], tmp_path / "cut_off")
    cut_off, newest = tmp_path / "cut_off", step_path(tmp_path / "cut_off", 6)
    (cut_off / "final.safetensors").write_bytes(
        (whole[0] / "final.safetensors").read_bytes()[:-100]
    )
    content = bytearray(newest.read_bytes())
    content[len(content) // 2] ^= 1
    newest.write_bytes(content)
    with caplog.at_level(logging.WARNING):
        _, metrics = trainer.train(tmp_path / "resumed", SEED, resume=cut_off)
    reports = [record.getMessage() for record in caplog.records]
    assert len(reports) == 2 and "final.safetensors" in reports[0] and newest.name in reports[1]
    assert all(
        "damaged" in report and "the checkpoint before it is used" in report for report in reports
    )
    assert_same_end(tmp_path / "resumed" / "final.safetensors", whole[0] / "final.safetensors")
    for name, values in metrics.items():
        np.testing.assert_array_equal(values, whole[1][name][4:], err_msg=name)


def test_folders_without_an_intact_checkpoint_are_refused(whole, tmp_path):
    with pytest.raises(CheckpointError, match="found no checkpoint"):
        newest_intact(tmp_path)
    (tmp_path / "step_5.safetensors").write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match=r"step_5\.safetensors: not a checkpoint"):
        newest_intact(tmp_path)
    final = load_checkpoint(whole[0] / "final.safetensors")
    save_checkpoint(tmp_path / "policy.safetensors", final.params, final.config, final.meta)
    with pytest.raises(CheckpointError, match=r"policy\.safetensors: found a policy alone"):
        newest_intact(tmp_path / "policy.safetensors")


def test_another_machine_or_software_is_a_warning(whole, caplog):
    checkpoint = newest_intact(whole[0])
    check_same_run(checkpoint, checkpoint.meta)
    assert caplog.text == ""
    changes = {"software": {"jax": "0.1.0"}, "machine": {"threads": 1000}}
    check_same_run(checkpoint._replace(meta=checkpoint.meta | changes), checkpoint.meta)
    for message in (
        "software.jax: found '0.1.0'",
        "machine.threads: found 1000",
        "perhaps not bit for bit",
    ):
        assert message in caplog.text


@pytest.mark.slow
def test_a_complete_run_is_extended(whole, tmp_path, capsys):
    """The first 7 updates are those of the shorter run; a cut in what follows changes no bit."""
    longer = Trainer(dataclasses.replace(CONFIG, total_timesteps=10 * BATCH), ENV_ID)
    uncut, cut = tmp_path / "uncut", tmp_path / "cut"
    for folder in (uncut, cut):
        shutil.copytree(whole[0], folder)
    final, metrics = longer.train(uncut, SEED, EVERY_OTHER_UPDATE, uncut)
    assert final.steps == 10 * BATCH and len(metrics["learning_rate"]) == 3
    assert "learning rate: 6e-05 up to step 2688, 0.000942 from there" in capsys.readouterr().out
    shutil.copy(whole[0] / "final.safetensors", step_path(cut, 7))
    shutil.copy(step_path(uncut, 8), step_path(cut, 8))
    (cut / "final.safetensors").unlink()
    longer.train(cut, SEED, EVERY_OTHER_UPDATE, cut)
    assert_same_end(cut / "final.safetensors", final.path)
    with pytest.raises(
        CheckpointError, match=f"steps: found {10 * BATCH}, expected at most {7 * BATCH}"
    ):
        Trainer(CONFIG, ENV_ID).train(uncut, SEED, resume=uncut)


def poison(trainer, monkeypatch, from_update):
    """Have training give parameters that are not finite after some updates."""
    update, done = trainer.update, [-1]  # the first call only compiles

    def poisoned(runner):
        runner, metrics = update(runner)
        done[0] += 1
        if done[0] <= from_update:
            return runner, metrics
        params = jax.tree.map(lambda leaf: leaf * jnp.nan, runner.train_state.params)
        return runner._replace(train_state=runner.train_state.replace(params=params)), metrics

    monkeypatch.setattr(trainer, "update", poisoned)


def test_a_diverged_run_ends_at_once_and_no_checkpoint_has_it(trainer, tmp_path, monkeypatch):
    poison(trainer, monkeypatch, from_update=2)
    with pytest.raises(DivergedError) as caught:
        trainer.train(tmp_path, SEED, EVERY_OTHER_UPDATE)
    last_good = step_path(tmp_path, 2)
    for part in (
        f"steps {2 * BATCH} and {4 * BATCH}",
        "not finite",
        str(last_good),
        "--learning-rate",
    ):
        assert part in str(caught.value)
    assert newest_intact(tmp_path).path == last_good


def test_an_evaluation_that_fails_does_not_end_the_training(trainer, tmp_path, monkeypatch, caplog):
    def fail(*arguments):
        raise RuntimeError("out of paint\nand more")

    monkeypatch.setattr(monitor, "NUM_STEPS", 20)
    monkeypatch.setattr(monitor, "can_record", lambda: False)
    monkeypatch.setattr(monitor, "fly_many", fail)
    trainer.train(tmp_path, SEED, Options(evaluate_every=100 * BATCH, evaluation_episodes=2))
    assert (tmp_path / "final.safetensors").exists()
    assert (
        f"after {7 * BATCH} steps" in caplog.text
        and "out of paint and more; training goes on" in caplog.text
    )


@pytest.fixture
def stoppable():
    """Let SIGINT raise, which whoever is started in the background by a shell ignores."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.usefixtures("stoppable")
def test_a_signal_ends_the_run_with_a_checkpoint(trainer, whole, tmp_path, monkeypatch, number):
    advance = Run._advance

    def stop_after(self):
        advance(self)
        os.kill(os.getpid(), number)

    with monkeypatch.context() as patch, pytest.raises(Stopped) as caught:
        patch.setattr(Run, "_advance", stop_after)
        trainer.train(tmp_path, SEED, Options(checkpoint_every=3 * BATCH))
    expected = f"stopped by {number.name} at {3 * BATCH} steps; continue with --resume {tmp_path}"
    assert str(caught.value) == expected and caught.value.signal_number == number
    assert newest_intact(tmp_path).path == step_path(tmp_path, 3)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    trainer.train(tmp_path, SEED, resume=tmp_path)
    assert_same_end(tmp_path / "final.safetensors", whole[0] / "final.safetensors")


def start(out, *flags):
    """Start a training in a process of its own."""
    command = [sys.executable, "-m", "baselines.purejaxrl_ppo.train_ppo", "--out", str(out), *flags]
    return subprocess.Popen(command, cwd=ROOT)


@pytest.mark.slow
def test_a_run_killed_at_any_moment_ends_in_the_same_bits(tmp_path, monkeypatch):
    """Of the id with the most state: a drone and noise of each episode, and earlier commands."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "compiled"))
    flags = (
        "--env-id FlyTrackRobust-v0 --num-envs 16 --num-steps 24 --num-minibatches 4 "
        f"--hidden-sizes 8 --total-timesteps {1500 * BATCH} --seed {SEED}"
    ).split()
    intervals = f"--evaluate-every 0 --checkpoint-every {20 * BATCH}".split()
    rng, whole, out = random.Random(0), tmp_path / "whole", tmp_path / "killed"
    assert start(whole, *flags, *intervals).wait() == 0
    process = start(out, *flags, *intervals)
    for _ in range(2):
        known = set(checkpoints_in(out))
        while process.poll() is None and set(checkpoints_in(out)) == known:
            time.sleep(0.001)
        time.sleep(rng.uniform(0.0, 0.5))
        process.kill()
        assert process.wait() == -signal.SIGKILL
        for path in known.union(checkpoints_in(out)):
            load_checkpoint(path)
        process = start(out, "--resume", str(out), *intervals)
    assert process.wait() == 0
    assert_same_end(out / "final.safetensors", whole / "final.safetensors")
