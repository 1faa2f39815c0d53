"""A training run: cut off and taken up again, damaged, watched, tracked; it ends in the same bits."""

import logging
import shutil
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from baselines.purejaxrl_ppo import (
    CheckpointError,
    Config,
    load_checkpoint,
)
from baselines.purejaxrl_ppo.checkpoint import as_named_arrays, save_checkpoint
from baselines.purejaxrl_ppo.metrics import summarise_updates
from baselines.purejaxrl_ppo.resume import check_same_run, describe_run, newest_intact, restore_runner
from baselines.purejaxrl_ppo.run import is_due, next_due
from baselines.purejaxrl_ppo.training import Options, Trainer
from tests.support.ppo_runs import BATCH, CONFIG, EVERY_OTHER_UPDATE, SEED, assert_same_end

ROOT = Path(__file__).parents[2]


def test_checkpoints_are_written_at_the_steps_asked_for(whole):
    steps = [0, 2 * BATCH, 4 * BATCH, 6 * BATCH]
    assert {path.name for path in whole[0].iterdir()} == {"final.safetensors"} | {
        f"step_{step}.msgpack" for step in steps
    }
    training = load_checkpoint(whole[0] / "final.safetensors").training
    for part in ("opt_state", "env_state", "observation", "episodes", "key"):
        assert any(part in name for name in training), part


@pytest.mark.parametrize("updates", [0, 2, 6])
@pytest.mark.parametrize("options", [Options(), EVERY_OTHER_UPDATE])
def test_a_resumed_run_ends_bit_for_bit(trainer, whole, tmp_path, updates, options):
    source = whole[0] / f"step_{updates * BATCH}.msgpack"
    _, metrics = trainer.train(tmp_path, SEED, options._replace(resume=source))
    assert_same_end(tmp_path / "final.safetensors", whole[0] / "final.safetensors")
    for name, values in metrics.items():
        np.testing.assert_array_equal(values, whole[1][name][updates:], err_msg=name)


def test_a_run_that_is_complete_stays_as_it_is(trainer, whole, tmp_path):
    _, metrics = trainer.train(tmp_path, SEED, Options(resume=whole[0]))
    assert metrics == {}
    assert_same_end(tmp_path / "final.safetensors", whole[0] / "final.safetensors")


def test_another_seed_ends_elsewhere(trainer, whole, tmp_path):
    trainer.train(tmp_path, SEED + 1, Options())
    found, other = (
        as_named_arrays(load_checkpoint(folder / "final.safetensors").params)
        for folder in (tmp_path, whole[0])
    )
    kernels = [name for name in found if name.endswith("kernel")]
    assert kernels and not any(np.array_equal(found[name], other[name]) for name in kernels)


def test_the_newest_intact_checkpoint_is_taken(trainer, whole, tmp_path, caplog):
    cut_off = tmp_path / "cut_off"
    shutil.copytree(whole[0], cut_off)
    (cut_off / "final.safetensors").write_bytes((whole[0] / "final.safetensors").read_bytes()[:-100])
    newest = cut_off / f"step_{6 * BATCH}.msgpack"
    content = bytearray(newest.read_bytes())
    content[len(content) // 2] ^= 1
    newest.write_bytes(content)
    with caplog.at_level(logging.WARNING):
        trainer.train(tmp_path / "resumed", SEED, Options(resume=cut_off))
    reports = [record.getMessage() for record in caplog.records]
    assert len(reports) == 2 and "final.safetensors" in reports[0] and newest.name in reports[1]
    assert all("damaged" in report and "the checkpoint before it is used" in report for report in reports)
    assert newest_intact(cut_off)[0].name == f"step_{4 * BATCH}.msgpack"
    assert_same_end(tmp_path / "resumed" / "final.safetensors", whole[0] / "final.safetensors")


def test_what_a_killed_process_was_writing_is_removed(trainer, whole, tmp_path):
    out = tmp_path / "killed"
    shutil.copytree(whole[0], out)
    (out / "final.safetensors").unlink()
    others = {".step_5.msgpack.swp", f".mine.msgpack.{'0' * 16}", "step_5.msgpack~"}
    for name in {*others, f".step_{7 * BATCH}.msgpack.{'a1' * 8}", f".final.safetensors.{'0' * 16}"}:
        (out / name).write_bytes(b"half")
    trainer.train(out, SEED, Options(resume=out))
    assert {path.name for path in out.iterdir()} == {path.name for path in whole[0].iterdir()} | others


def test_folders_without_an_intact_checkpoint_are_refused(whole, tmp_path):
    with pytest.raises(CheckpointError, match="found no checkpoint"):
        newest_intact(tmp_path)
    (tmp_path / "step_5.msgpack").write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match=r"step_5\.msgpack: not a checkpoint"):
        newest_intact(tmp_path)
    final = load_checkpoint(whole[0] / "final.safetensors")
    save_checkpoint(tmp_path / "policy.msgpack", final.params, final.config, final.meta)
    with pytest.raises(CheckpointError, match=r"policy\.msgpack: found a policy alone"):
        newest_intact(tmp_path / "policy.msgpack")


def test_a_checkpoint_of_another_run_is_refused_field_by_field(trainer, whole, tmp_path):
    path, checkpoint = newest_intact(whole[0])
    other = Trainer(Config(learning_rate=1e-4), "FlyTrack-v0", track="split_s")
    description = describe_run(other.env, other.env_id, other.track, other.config, seed=1)
    description["model"]["parameters"]["m"] = 0.5
    with pytest.raises(CheckpointError) as caught:
        check_same_run(path, checkpoint, description)
    message = str(caught.value)
    for part in (
        "final.safetensors: does not fit",
        "env_id: found 'FlyTrackRobust-v0', expected 'FlyTrack-v0'",
        "seed: found 3, expected 1",
        "config.learning_rate: found 0.003, expected 0.0001",
        "config.num_envs: found 16, expected 1024",
        "row 8",
        "more",
    ):
        assert part in message, message
    with pytest.raises(CheckpointError, match=r"config\.learning_rate: found 0\.003, expected 0\.001$"):
        own = describe_run(trainer.env, trainer.env_id, trainer.track, CONFIG, SEED)
        own["config"]["learning_rate"] = 0.001
        check_same_run(path, checkpoint, own)


def test_a_state_of_other_shapes_is_refused_leaf_by_leaf(trainer, whole):
    path, checkpoint = newest_intact(whole[0])
    target = jax.eval_shape(trainer.start, jax.random.key(0))
    training = dict(checkpoint.training)
    training["observation"] = training["observation"][:5]
    training["key"] = training["key"].astype(np.int64)
    del training["episodes.so_far"]
    training["surplus"] = np.zeros(3)
    with pytest.raises(CheckpointError) as caught:
        restore_runner(path, checkpoint._replace(training=training), target)
    for part in (
        "observation: found shape (5, ",
        "key: found int64, expected uint32",
        "episodes.so_far: missing",
        "surplus: found, but not expected",
    ):
        assert part in str(caught.value)


@pytest.mark.parametrize(("every", "batch_size"), [(1, 7), (7, 7), (10, 7), (100, 7), (13, 64)])
def test_intervals_hit_every_multiple_once(every, batch_size):
    due = [n for n in range(1, 200) if n * batch_size // every > (n - 1) * batch_size // every]
    assert [n for n in range(1, 200) if is_due(n, every, batch_size)] == due
    for start in range(150):
        assert next_due(start, every, batch_size) == min(n for n in due if n > start)
    assert next_due(3, None, batch_size) == float("inf") and not is_due(3, None, batch_size)


def test_means_over_updates_are_weighted_by_what_they_are_means_of():
    metrics = {
        "episodes_ended": np.array([1, 3]),
        "laps_completed": np.array([0, 0]),
        "episode_return": np.array([2.0, 6.0]),
        "lap_time_s": np.array([0.0, 0.0]),
        "entropy": np.array([1.0, 2.0]),
    }
    assert summarise_updates(metrics) == {
        "episodes_ended": 4,
        "laps_completed": 0,
        "episode_return": 5.0,
        "entropy": 1.5,
    }


def command_line(out: Path, *arguments: str) -> list[str]:
    settings = f"--num-envs 16 --num-steps 64 --total-timesteps {300 * 1024} --hidden-sizes 8 --seed 5"
    watching = f"--checkpoint-every {10 * 1024} --evaluate-every 0 --no-tracking --out {out}"
    train = "-m baselines.purejaxrl_ppo.train_ppo"
    return [sys.executable, *train.split(), *settings.split(), *watching.split(), *arguments]


@pytest.mark.slow
def test_a_run_killed_at_any_moment_ends_in_the_same_bits(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    subprocess.run(command_line(whole), cwd=ROOT, check=True, capture_output=True, timeout=600)
    rng = np.random.default_rng()
    resume, kills = [], 0
    while not (killed / "final.safetensors").exists():
        process = subprocess.Popen(
            command_line(killed, *resume), cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        before = set(killed.glob("step_*.msgpack"))
        deadline_s = time.monotonic() + 300
        while set(killed.glob("step_*.msgpack")) == before and process.poll() is None:
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
        if kills < 4:
            time.sleep(float(rng.uniform(0.0, 0.3)))
            process.kill()
            kills += 1
        process.wait(timeout=600)
        resume = ["--resume", str(killed)]
    assert kills == 4
    assert_same_end(killed / "final.safetensors", whole / "final.safetensors")
