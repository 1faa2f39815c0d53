"""A training run: cut off and taken up again, damaged, watched, tracked; it ends in the same bits."""

import json
import logging
import re
import shutil
import socket
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
    monitor,
    tracking,
    train_ppo,
)
from baselines.purejaxrl_ppo.checkpoint import save_checkpoint
from baselines.purejaxrl_ppo.metrics import summarise_updates
from baselines.purejaxrl_ppo.named_arrays import as_named_arrays
from baselines.purejaxrl_ppo.options import is_due, next_due
from baselines.purejaxrl_ppo.resume import check_same_run, describe_run, newest_intact, restore_runner
from baselines.purejaxrl_ppo.run import Run
from baselines.purejaxrl_ppo.training import Options, Trainer
from flytrack_env.rollout import load_rollout
from tests.ppo_runs import BATCH, CONFIG, DEAD_URI, EVERY_OTHER_UPDATE, SEED, assert_same_end, make_trainer

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def trainer():
    return make_trainer()


@pytest.fixture(scope="module")
def whole(trainer, tmp_path_factory):
    """An uninterrupted run: its folder and its metrics."""
    out = tmp_path_factory.mktemp("whole")
    return out, trainer.train(out, SEED, EVERY_OTHER_UPDATE)[1]


def test_checkpoints_are_written_at_the_steps_asked_for(whole):
    steps = [0, 2 * BATCH, 4 * BATCH, 6 * BATCH]
    assert {path.name for path in whole[0].iterdir()} == {"final.msgpack"} | {
        f"step_{step}.msgpack" for step in steps
    }
    training = load_checkpoint(whole[0] / "final.msgpack").training
    for part in ("opt_state", "env_state", "observation", "episodes", "key"):
        assert any(part in name for name in training), part


@pytest.mark.parametrize("updates", [0, 2, 6])
@pytest.mark.parametrize("options", [Options(), EVERY_OTHER_UPDATE])
def test_a_resumed_run_ends_bit_for_bit(trainer, whole, tmp_path, updates, options):
    source = whole[0] / f"step_{updates * BATCH}.msgpack"
    _, metrics = trainer.train(tmp_path, SEED, options._replace(resume=source))
    assert_same_end(tmp_path / "final.msgpack", whole[0] / "final.msgpack")
    for name, values in metrics.items():
        np.testing.assert_array_equal(values, whole[1][name][updates:], err_msg=name)


def test_a_run_that_is_complete_stays_as_it_is(trainer, whole, tmp_path):
    _, metrics = trainer.train(tmp_path, SEED, Options(resume=whole[0]))
    assert metrics == {}
    assert_same_end(tmp_path / "final.msgpack", whole[0] / "final.msgpack")


def test_another_seed_ends_elsewhere(trainer, whole, tmp_path):
    trainer.train(tmp_path, SEED + 1, Options())
    found, other = (
        as_named_arrays(load_checkpoint(folder / "final.msgpack").params) for folder in (tmp_path, whole[0])
    )
    kernels = [name for name in found if name.endswith("kernel")]
    assert kernels and not any(np.array_equal(found[name], other[name]) for name in kernels)


def test_the_newest_intact_checkpoint_is_taken(trainer, whole, tmp_path, caplog):
    cut_off = tmp_path / "cut_off"
    shutil.copytree(whole[0], cut_off)
    (cut_off / "final.msgpack").write_bytes((whole[0] / "final.msgpack").read_bytes()[:-100])
    newest = cut_off / f"step_{6 * BATCH}.msgpack"
    content = bytearray(newest.read_bytes())
    content[len(content) // 2] ^= 1
    newest.write_bytes(content)
    with caplog.at_level(logging.WARNING):
        trainer.train(tmp_path / "resumed", SEED, Options(resume=cut_off))
    reports = [record.getMessage() for record in caplog.records]
    assert len(reports) == 2 and "final.msgpack" in reports[0] and newest.name in reports[1]
    assert all("damaged" in report and "the checkpoint before it is used" in report for report in reports)
    assert newest_intact(cut_off)[0].name == f"step_{4 * BATCH}.msgpack"
    assert_same_end(tmp_path / "resumed" / "final.msgpack", whole[0] / "final.msgpack")


def test_folders_without_an_intact_checkpoint_are_refused(whole, tmp_path):
    with pytest.raises(CheckpointError, match="found no checkpoint"):
        newest_intact(tmp_path)
    (tmp_path / "step_5.msgpack").write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match=r"step_5\.msgpack: not a checkpoint"):
        newest_intact(tmp_path)
    final = load_checkpoint(whole[0] / "final.msgpack")
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
        "final.msgpack: does not fit",
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


# MLflow.

ISSUE_METRICS = {
    "episode_return",
    "episode_length",
    "policy_loss",
    "value_loss",
    "entropy",
    "approx_kl",
    "clip_fraction",
    "explained_variance",
    "episode_gates_passed",
    "episode_laps",
    "evaluation_success",
    "episode_crash",
    "episode_ground",
    "episode_out_of_bounds",
    "episode_missed_gate",
    "episode_battery_empty",
    "episode_truncated",
    "gate_distance_m",
    "steps_per_second",
    "evaluation_ended_crash",
    "evaluation_ended_ground",
    "evaluation_ended_out_of_bounds",
    "evaluation_ended_missed_gate",
    "evaluation_ended_battery_empty",
    "evaluation_ended_time_limit",
    "evaluation_gates",
    "evaluation_laps",
}

quiet_mlflow = pytest.mark.filterwarnings("default")  # its own dependencies' deprecations


def only_run(uri):
    from mlflow import MlflowClient

    client = MlflowClient(tracking_uri=uri)
    experiment = client.get_experiment_by_name(tracking.EXPERIMENT)
    (run,) = client.search_runs([experiment.experiment_id])
    return client, run


def history(client, run, name):
    return [(metric.step, metric.value) for metric in client.get_metric_history(run.info.run_id, name)]


@quiet_mlflow
def test_mlflow_is_told_everything_once_though_the_run_was_cut_off(trainer, tmp_path, monkeypatch):
    monkeypatch.setattr(monitor, "NUM_STEPS", 20)
    uri = tracking.local_uri(tmp_path)
    options = EVERY_OTHER_UPDATE._replace(evaluate_every=4 * BATCH, evaluation_episodes=2, tracking_uri=uri)
    trainer.train(tmp_path, SEED, options)
    client, run = only_run(uri)
    description = load_checkpoint(tmp_path / "final.msgpack").meta
    for part in ("config", "environment", "model"):
        for name, text in tracking.flatten({part: description[part]}):
            assert run.data.params[name] == text
    assert run.data.params["seed"] == str(SEED) and run.data.params["env_id"] == "FlyTrackRobust-v0"
    assert set(run.data.metrics) >= ISSUE_METRICS
    page = (ROOT / "docs" / "baseline.md").read_text(encoding="utf-8")
    assert {name for name in run.data.metrics if f"`{name}`" not in page} == set()
    before = history(client, run, "policy_loss")
    assert [step for step, _ in before] == [2 * BATCH, 4 * BATCH, 6 * BATCH, 7 * BATCH]
    assert [step for step, _ in history(client, run, "evaluation_success")] == [4 * BATCH, 7 * BATCH]
    names = {file.path for file in client.list_artifacts(run.info.run_id, "evaluation")}
    assert {f"evaluation/position_density_{7 * BATCH}.png", f"evaluation/rollout_{4 * BATCH}.npy"} <= names
    assert len(client.list_artifacts(run.info.run_id, "checkpoints")) == 5
    states, actions = load_rollout(tmp_path / "evaluation" / f"rollout_{7 * BATCH}.npy")
    assert states.shape[1] + actions.shape[1] == 25

    # Killed after the checkpoint at 4, while the journal was being written.
    for name in ("final.msgpack", f"step_{6 * BATCH}.msgpack"):
        (tmp_path / name).unlink()
    with (tmp_path / tracking.JOURNAL).open("a") as file:
        file.write('{"kind": "metr')
    trainer.train(tmp_path, SEED, options._replace(resume=tmp_path))
    client, run = only_run(uri)
    assert run.info.status == "FINISHED"
    assert history(client, run, "policy_loss") == before


@quiet_mlflow
def test_a_server_that_is_down_does_not_end_the_training(
    trainer, whole, tmp_path, caplog, monkeypatch, capsys
):
    trainer.train(tmp_path, SEED, EVERY_OTHER_UPDATE._replace(tracking_uri=DEAD_URI))
    assert_same_end(tmp_path / "final.msgpack", whole[0] / "final.msgpack")
    (report,) = reports_of(caplog)
    command = f"python -m baselines.purejaxrl_ppo.tracking {tmp_path} --tracking-uri {DEAD_URI}"
    assert DEAD_URI in report and command in report
    uri = tracking.local_uri(tmp_path / "store")
    (tmp_path / "store").mkdir()
    for _ in range(2):  # the second time, there is nothing left to send
        monkeypatch.setattr(sys, "argv", ["tracking", str(tmp_path), "--tracking-uri", uri])
        tracking.main()
    assert "uploaded: " in capsys.readouterr().out
    client, run = only_run(uri)
    assert run.data.params["config.num_envs"] == "16" and run.info.status == "FINISHED"
    assert len(history(client, run, "value_loss")) == 4
    assert len(client.list_artifacts(run.info.run_id, "checkpoints")) == 5


def reports_of(caplog):
    return [record.getMessage() for record in caplog.records if record.name == tracking.__name__]


@quiet_mlflow
def test_a_server_that_never_answers_is_given_up(trainer, whole, tmp_path, caplog, monkeypatch):
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "1")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    with socket.create_server(("127.0.0.1", 0)) as silent:
        uri = f"http://127.0.0.1:{silent.getsockname()[1]}"
        trainer.train(tmp_path, SEED, Options(tracking_uri=uri))
    assert_same_end(tmp_path / "final.msgpack", whole[0] / "final.msgpack")
    assert len(reports_of(caplog)) == 1


def test_a_server_that_goes_down_under_way_is_reported_once(trainer, tmp_path, caplog, monkeypatch):
    sent = []

    def send(journal, uri):
        if sent:
            raise ConnectionError("gone")
        sent.append(len(journal.entries))

    monkeypatch.setattr(tracking, "send_journal", send)
    monkeypatch.setattr(tracking, "SEND_EVERY_S", -1.0)
    trainer.train(tmp_path, SEED, EVERY_OTHER_UPDATE._replace(tracking_uri="http://127.0.0.1:9"))
    (report,) = reports_of(caplog)
    assert "ConnectionError: gone" in report and sent == [2]  # what the run is, and that it runs
    kinds = [entry["kind"] for entry in tracking.Journal(tmp_path).entries]
    assert (kinds.count("metrics"), kinds.count("file"), kinds[-1]) == (4, 5, "status")


@pytest.mark.parametrize(("error", "status"), [(KeyboardInterrupt, "KILLED"), (OSError, "FAILED")])
def test_how_a_run_ended_is_told(trainer, tmp_path, monkeypatch, error, status):
    def fail(*arguments):
        raise error

    monkeypatch.setattr(tracking, "send_journal", lambda journal, uri: None)
    monkeypatch.setattr(Run, "checkpoint", fail)
    with pytest.raises(error):
        trainer.train(tmp_path, SEED, Options(tracking_uri=DEAD_URI))
    assert tracking.Journal(tmp_path).entries[-1]["status"] == status


def test_mlflow_is_imported_when_it_is_used():
    code = "import sys, baselines.purejaxrl_ppo.train_ppo; sys.exit('mlflow' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=120)


@quiet_mlflow
def test_uploading_refuses_what_it_cannot_do(tmp_path, monkeypatch, capsys):
    for arguments, message in (
        ([str(tmp_path)], "found no tracking.jsonl"),
        ([str(tmp_path / "run")], f"{DEAD_URI}: cannot be used"),
    ):
        tracking.Journal(tmp_path / "run").append("run", experiment="e", name="n", params={})
        monkeypatch.setattr(sys, "argv", ["tracking", *arguments, "--tracking-uri", DEAD_URI])
        with pytest.raises(SystemExit):
            tracking.main()
        assert message in capsys.readouterr().err


# The command.


def plans_of(*arguments):
    return train_ppo.make_plans(train_ppo.make_parser().parse_args([*map(str, arguments)]))


def test_resuming_takes_from_the_checkpoint_what_is_not_given(whole, tmp_path):
    arguments = train_ppo.make_parser().parse_args(["--resume", str(whole[0])])
    (plan,) = train_ppo.make_plans(arguments)
    assert (plan.seed, plan.out, plan.resume) == (SEED, whole[0], whole[0] / "final.msgpack")
    found = train_ppo.make_trainer(arguments, plan.checkpoint)
    assert found.config == CONFIG and found.env_id == "FlyTrackRobust-v0"
    check_same_run(
        plan.resume,
        plan.checkpoint,
        describe_run(found.env, found.env_id, found.track, found.config, plan.seed),
    )
    assert plans_of("--resume", whole[0], "--out", tmp_path)[0].out == tmp_path


def test_resuming_keeps_the_reward_that_was_trained_for(whole):
    checkpoint = load_checkpoint(whole[0] / "final.msgpack")
    checkpoint.meta["environment"]["reward.off_centre"] = -0.25
    parser = train_ppo.make_parser()
    kept = train_ppo.make_trainer(parser.parse_args(["--resume", "x"]), checkpoint)
    asked = train_ppo.make_trainer(parser.parse_args(["--reward", "off_centre=-0.5"]), checkpoint)
    assert kept.env.default_params.reward.off_centre == -0.25
    assert asked.env.default_params.reward.off_centre == -0.5


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
        (1, tmp_path / "seed1", tmp_path / "seed1" / "final.msgpack"),
    ]
    with pytest.raises(ValueError, match="seed1 holds the checkpoints of a run"):
        plans_of("--num-seeds", 2, "--out", tmp_path)
    with pytest.raises(ValueError, match="holds the checkpoints of a run"):
        plans_of("--out", whole[0])
    with pytest.raises(ValueError, match=r"--resume: found .*final\.msgpack, expected the folder"):
        plans_of("--num-seeds", 2, "--resume", whole[0] / "final.msgpack")
    with pytest.raises(ValueError, match="--num-seeds: found 0"):
        plans_of("--num-seeds", 0)


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
    while not (killed / "final.msgpack").exists():
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
    assert_same_end(killed / "final.msgpack", whole / "final.msgpack")


@pytest.mark.slow
@quiet_mlflow
def test_a_served_store_is_told_everything(trainer, tmp_path):
    port = 5713
    command = f"{sys.executable} -m mlflow server --port {port} --workers 1"
    store = f"sqlite:///{tmp_path}/server.db"
    server = subprocess.Popen(
        [*command.split(), "--backend-store-uri", store, "--artifacts-destination", str(tmp_path)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    uri = f"http://127.0.0.1:{port}"
    try:
        _wait_for(uri)
        trainer.train(tmp_path / "run", SEED, EVERY_OTHER_UPDATE._replace(tracking_uri=uri))
        client, run = only_run(uri)
        assert run.info.status == "FINISHED" and len(history(client, run, "entropy")) == 4
        assert len(client.list_artifacts(run.info.run_id, "checkpoints")) == 5
    finally:
        server.terminate()
        server.wait(timeout=60)


def _wait_for(uri):
    from urllib.error import URLError
    from urllib.request import urlopen

    deadline_s = time.monotonic() + 120
    while True:
        try:
            return urlopen(f"{uri}/health").read()
        except URLError:
            assert time.monotonic() < deadline_s, f"{uri}: no server"
            time.sleep(0.5)


def test_journal_is_plain_json_lines(tmp_path):
    journal = tracking.Journal(tmp_path)
    journal.append("metrics", step=1, values={"entropy": 0.5})
    (line,) = (tmp_path / tracking.JOURNAL).read_text().splitlines()
    assert json.loads(line)["values"] == {"entropy": 0.5}
