"""What goes wrong while a policy trains: kills, errors, divergence, damaged files; nothing is lost."""

import logging

import jax
import jax.numpy as jnp
import pytest

from baselines.purejaxrl_ppo import monitor, tracking
from baselines.purejaxrl_ppo import run as run_module
from baselines.purejaxrl_ppo.resume import newest_intact
from baselines.purejaxrl_ppo.run import DivergedError
from baselines.purejaxrl_ppo.training import Options
from tests.ppo_runs import BATCH, DEAD_URI, EVERY_OTHER_UPDATE, SEED, make_trainer

EVALUATED = EVERY_OTHER_UPDATE._replace(evaluate_every=2 * BATCH, evaluation_episodes=2)


@pytest.fixture(scope="module")
def trainer():
    return make_trainer()


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
    assert files_told(tmp_path) == [*steps, "final.msgpack"]


# Evaluations that fail.


@pytest.mark.parametrize("broken", ["fly_many", "draw_position_density", "record_flight"])
def test_an_evaluation_that_fails_does_not_end_the_training(trainer, tmp_path, monkeypatch, caplog, broken):
    def fail(*arguments):
        raise RuntimeError("out of paint\nand more")

    monkeypatch.setattr(monitor, "NUM_STEPS", 20)
    monkeypatch.setattr(monitor, "find_spec", lambda name: None)
    monkeypatch.setattr(monitor, broken, fail)
    options = Options(evaluate_every=100 * BATCH, evaluation_episodes=2)
    with caplog.at_level(logging.WARNING):
        trainer.train(tmp_path, SEED, options)
    assert (tmp_path / "final.msgpack").exists()
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
