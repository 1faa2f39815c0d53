"""What goes wrong while a policy trains: kills, errors, divergence, damaged files; nothing is lost."""

import logging
import os
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import flytrack_env
from baselines.purejaxrl_ppo import monitor, tracking
from baselines.purejaxrl_ppo import run as run_module
from baselines.purejaxrl_ppo.checkpoint import Checkpoint
from baselines.purejaxrl_ppo.resume import check_same_run, newest_intact, warn_of_other_bits
from baselines.purejaxrl_ppo.run import DivergedError
from baselines.purejaxrl_ppo.training import Options
from tests.support.ppo_runs import BATCH, DEAD_URI, EVERY_OTHER_UPDATE, SEED

EVALUATED = EVERY_OTHER_UPDATE._replace(evaluate_every=2 * BATCH, evaluation_episodes=2)


@pytest.fixture
def no_store(monkeypatch):
    """Keep all that is told in the journal, and send it nowhere."""
    monkeypatch.setattr(tracking, "send_journal", lambda journal, uri: None)


@pytest.fixture
def evaluations(monkeypatch):
    """Replace the flights of evaluations: they all succeed, each best lap slower than the last."""
    asked = []

    def evaluate_policy(env, network, params, num_episodes, out, steps, is_recorded=False):
        asked.append(steps)
        return {"evaluation_success": 1.0, "evaluation_best_lap_s": 7.0 + len(asked)}, []

    monkeypatch.setattr(run_module, "evaluate_policy", evaluate_policy)
    return asked


def told(folder, kind):
    return tracking.Journal(folder).of_kind(kind)


def files_told(folder):
    return [entry["path"] for entry in told(folder, "file")]


# Divergence.


def poison(trainer, monkeypatch, from_update):
    """Make the first parameter NaN in every chunk that begins at an update or later."""
    chunk, done = trainer.chunk, [0]

    def poisoned(runner, count):
        runner, rows = chunk(runner, count)
        done[0] += int(count)
        if done[0] <= from_update:
            return runner, rows
        params = jax.tree.map(lambda leaf: leaf * jnp.nan, runner.train_state.params)
        return runner._replace(train_state=runner.train_state.replace(params=params)), rows

    monkeypatch.setattr(trainer, "chunk", poisoned)


def test_a_diverged_run_ends_at_once_and_no_checkpoint_has_it(trainer, tmp_path, monkeypatch, no_store):
    poison(trainer, monkeypatch, from_update=2)
    options = EVERY_OTHER_UPDATE._replace(tracking_uri=DEAD_URI)
    with pytest.raises(DivergedError) as caught:
        trainer.train(tmp_path, SEED, options)
    last_good = tmp_path / f"step_{2 * BATCH}.msgpack"
    for part in (f"between steps {2 * BATCH} and {4 * BATCH}", "params", str(last_good), "--learning-rate"):
        assert part in str(caught.value)
    assert newest_intact(tmp_path)[0] == last_good
    assert [entry["step"] for entry in told(tmp_path, "metrics")] == [2 * BATCH, 4 * BATCH]
    assert told(tmp_path, "status")[-1]["status"] == "FAILED"


# Kills.


def test_an_evaluation_that_was_cut_off_is_told_after_the_resume(trainer, tmp_path, monkeypatch, no_store):
    def evaluate_policy(env, network, params, num_episodes, out, steps, is_recorded=False):
        if steps == 4 * BATCH and not is_resumed:
            raise KeyboardInterrupt
        return {"evaluation_success": 1.0}, []

    is_resumed = False
    monkeypatch.setattr(run_module, "evaluate_policy", evaluate_policy)
    options = EVALUATED._replace(tracking_uri=DEAD_URI)
    with pytest.raises(KeyboardInterrupt):
        trainer.train(tmp_path, SEED, options)
    is_resumed = True
    trainer.train(tmp_path, SEED, options._replace(resume=tmp_path))
    metrics = told(tmp_path, "metrics")
    assert [entry["step"] for entry in metrics] == [2 * BATCH, 4 * BATCH, 6 * BATCH, 7 * BATCH]
    assert all({"policy_loss", "evaluation_success"} <= entry["values"].keys() for entry in metrics)


def test_a_checkpoint_that_was_not_told_is_told_after_the_resume(trainer, tmp_path, monkeypatch, no_store):
    def die(self, path, group):
        raise KeyboardInterrupt

    options = EVERY_OTHER_UPDATE._replace(tracking_uri=DEAD_URI)
    with monkeypatch.context() as context, pytest.raises(KeyboardInterrupt):
        context.setattr(tracking.Tracker, "file", die)
        trainer.train(tmp_path, SEED, options)
    assert (tmp_path / "step_0.msgpack").exists() and files_told(tmp_path) == []
    trainer.train(tmp_path, SEED, options._replace(resume=tmp_path))
    steps = [f"step_{updates * BATCH}.msgpack" for updates in (0, 2, 4, 6)]
    assert files_told(tmp_path) == [*steps, "final.safetensors"]


# Evaluations that fail.


@pytest.mark.parametrize("broken", ["fly_many", "draw_position_density", "record_flights"])
def test_an_evaluation_that_fails_does_not_end_the_training(trainer, tmp_path, monkeypatch, caplog, broken):
    def fail(*arguments):
        raise RuntimeError("out of paint\nand more")

    monkeypatch.setattr(monitor, "NUM_STEPS", 20)
    monkeypatch.setattr(monitor, "can_record", lambda: broken == "record_flights")
    monkeypatch.setattr(monitor, broken, fail)
    options = Options(evaluate_every=100 * BATCH, evaluation_episodes=2)
    with caplog.at_level(logging.WARNING):
        trainer.train(tmp_path, SEED, options)
    assert (tmp_path / "final.safetensors").exists()
    (report,) = [record.getMessage() for record in caplog.records if record.name == monitor.__name__]
    assert f"after {7 * BATCH} steps" in report and report.endswith(
        "RuntimeError: out of paint; training goes on"
    )


def test_an_evaluation_can_be_interrupted(trainer, tmp_path, monkeypatch):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(monitor, "fly_many", interrupt)
    with pytest.raises(KeyboardInterrupt):
        trainer.train(tmp_path, SEED, EVALUATED)


# Folders that hold a run.


def test_no_run_is_overwritten(trainer, tmp_path, no_store):
    source, other = tmp_path / "source", tmp_path / "other"
    for folder in (source, other):
        trainer.train(folder, SEED, EVERY_OTHER_UPDATE)
    for resume in (None, source):
        with pytest.raises(ValueError, match=r"other holds the checkpoints of a run.*--resume .*other"):
            trainer.train(other, SEED, Options(resume=resume))
    for path in other.glob("*.msgpack"):
        path.unlink()
    journal = tracking.Journal(other)
    journal.append("run", experiment="e", name="n", params={})
    with pytest.raises(ValueError, match=r"tracking\.jsonl tells of a run, and no store has all of it"):
        trainer.train(other, SEED, Options(resume=source))
    journal.mark_sent(DEAD_URI, "id", 1)
    trainer.train(other, SEED, Options(resume=source, tracking_uri=DEAD_URI))
    assert len(told(other, "run")) == 1 and told(other, "run")[0]["name"] != "n"


def test_a_run_that_is_complete_is_left_alone(trainer, tmp_path, monkeypatch, no_store):
    options = EVERY_OTHER_UPDATE._replace(tracking_uri=DEAD_URI)
    trainer.train(tmp_path, SEED, options)
    final, journal = tmp_path / "final.safetensors", tmp_path / tracking.JOURNAL
    written, lines = final.stat().st_mtime_ns, journal.read_text().splitlines()
    # Killed before it could tell of its end.
    journal.write_text("\n".join(lines[:-2]) + "\n")
    monkeypatch.setattr(trainer, "chunk", None)
    monkeypatch.setattr(trainer, "start", None)
    for _ in range(2):
        assert trainer.train(tmp_path, SEED, options._replace(resume=tmp_path))[1] == {}
    assert final.stat().st_mtime_ns == written
    assert files_told(tmp_path)[-1] == "final.safetensors" and len(files_told(tmp_path)) == 5
    assert [entry["status"] for entry in told(tmp_path, "status")] == ["RUNNING", "FINISHED"]


# What a resumed run still knows.


def test_best_lap_and_success_outlive_a_resume(trainer, tmp_path, evaluations, no_store, monkeypatch):
    options = EVALUATED._replace(tracking_uri=DEAD_URI)
    trainer.train(tmp_path, SEED, options)
    for name in ("final.safetensors", f"step_{6 * BATCH}.msgpack"):
        (tmp_path / name).unlink()
    shown = []
    monkeypatch.setattr(monitor.LiveLine, "show", lambda self, *values: shown.append(values))
    trainer.train(tmp_path, SEED, Options(resume=tmp_path))
    assert shown[0][0] != 0.0 and shown[0][1] == shown[-1][1] == monitor.Seen(1.0, 8.0)
    best = [entry["values"]["evaluation_best_lap_so_far_s"] for entry in told(tmp_path, "metrics")]
    assert best == [8.0] * 4 and evaluations == [steps * BATCH for steps in (2, 4, 6, 7)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"package_version": "0.0.1"}, "package_version: found '0.0.1'"),
        ({"software": {"jax": "0.1.0"}}, "software.jax: found '0.1.0'"),
        ({"machine": {"threads": 1000}}, "machine.threads: found 1000"),
    ],
)
def test_another_machine_or_software_is_reported(trainer, caplog, change, message):
    description = trainer.describe(SEED)
    meta = {**description, "package_version": flytrack_env.__version__}
    same = Checkpoint(None, trainer.config, "", "", 0, meta)
    warn_of_other_bits(Path("run.msgpack"), same, description)
    assert caplog.text == ""
    other = same._replace(meta={**meta, **change})
    check_same_run(Path("run.msgpack"), other, description)
    warn_of_other_bits(Path("run.msgpack"), other, description)
    assert message in caplog.text and "perhaps not bit for bit" in caplog.text


# The journal.


def test_the_journal_is_on_the_disk_before_a_checkpoint(trainer, tmp_path, no_store, monkeypatch):
    written, fsync = [], os.fsync

    def watched(descriptor):
        name = Path(os.readlink(f"/proc/self/fd/{descriptor}")).name
        written.append(tracking.JOURNAL if name == tracking.JOURNAL else "checkpoint")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    trainer.train(tmp_path, SEED, EVERY_OTHER_UPDATE._replace(tracking_uri=DEAD_URI))
    assert written == [tracking.JOURNAL, "checkpoint"] * 5


def test_damaged_lines_are_skipped_and_keep_their_place(tmp_path, caplog):
    journal = tracking.Journal(tmp_path)
    for step in range(3):
        journal.append("metrics", step=step, values={})
    lines = journal.path.read_bytes().splitlines()
    damaged = b"\n".join([lines[0], b"\xff\x00", b'{"kind": "metrics"}', lines[2], b'{"kind'])
    journal.path.write_bytes(damaged)
    journal = tracking.Journal(tmp_path)
    (report,) = [record.getMessage() for record in caplog.records]
    assert f"{journal.path}: line 2, 3, 5: damaged or cut off, skipped" in report
    assert journal.path.read_bytes() == damaged  # whoever only reads does not write
    journal.append("status", status="RUNNING")
    again = tracking.Journal(tmp_path)
    assert again.entries == journal.entries and len(again.entries) == 6
    assert [entry["kind"] for entry in again.entries if entry["kind"] != "unreadable"] == [
        "metrics",
        "metrics",
        "status",
    ]


def test_after_a_full_disk_a_line_of_the_journal_is_whole_again(tmp_path):
    journal = tracking.Journal(tmp_path)
    journal.append("status", status="RUNNING")
    with Path("/dev/full").open("a") as full, pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "open", lambda *_, **__: full)
        with pytest.raises(OSError, match="No space left"):
            journal.append("metrics", step=1, values={})
    with journal.path.open("a") as file:
        file.write('{"kind": "met')  # as much as there was room for
    journal.append("status", status="FAILED")
    again = tracking.Journal(tmp_path)
    assert again.entries == journal.entries
    assert [entry.get("status") for entry in again.entries] == ["RUNNING", None, "FAILED"]


@pytest.mark.parametrize("content", [b"", b"nothing\n", b'{"kind": "run"}\n', b"[" * 10**5 + b"\n"])
def test_uploading_a_bad_journal_says_what_is_wrong(tmp_path, monkeypatch, capsys, content):
    (tmp_path / tracking.JOURNAL).write_bytes(content)
    monkeypatch.setattr(sys, "argv", ["tracking", str(tmp_path), "--tracking-uri", DEAD_URI])
    with pytest.raises(SystemExit):
        tracking.main()
    lines = content.count(b"\n")
    message = f"{tracking.JOURNAL}: found {lines} lines and none that says what the run is"
    assert message in capsys.readouterr().err


def test_a_store_that_moved_with_its_run_is_known_again(tmp_path):
    (tmp_path / "before" / "seed0").mkdir(parents=True)
    tracking.Journal(tmp_path / "before" / "seed0").mark_sent(
        tracking.local_uri(tmp_path / "before"), "id", 7
    )
    (tmp_path / "before").rename(tmp_path / "after")
    journal = tracking.Journal(tmp_path / "after" / "seed0")
    assert journal.sent(tracking.local_uri(tmp_path / "after")) == ("id", 7)
    assert journal.sent(DEAD_URI) == (None, 0)
