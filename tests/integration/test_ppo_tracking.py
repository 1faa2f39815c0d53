"""What a training run tells MLflow: everything, once, whether or not a server listens."""

import json
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from baselines.purejaxrl_ppo import (
    load_checkpoint,
    monitor,
    tracking,
)
from baselines.purejaxrl_ppo.run import Run
from baselines.purejaxrl_ppo.training import Options
from flytrack_env.rollout import load_rollout
from tests.support.ppo_runs import BATCH, DEAD_URI, EVERY_OTHER_UPDATE, SEED, assert_same_end

ROOT = Path(__file__).parents[2]
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
    description = load_checkpoint(tmp_path / "final.safetensors").meta
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
    for name in ("final.safetensors", f"step_{6 * BATCH}.msgpack"):
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
    assert_same_end(tmp_path / "final.safetensors", whole[0] / "final.safetensors")
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


@quiet_mlflow
def test_a_run_whose_id_a_kill_left_unnoted_is_found_again(tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    uri = tracking.local_uri(tmp_path)
    tracker = tracking.Tracker(tmp_path / "run", uri, "name", {"seed": 3})

    def die(self, uri, run_id, count):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(tracking.Journal, "mark_sent", die)
        tracker.begin()
    run_id = tracking.send_journal(tracking.Journal(tmp_path / "run"), uri)
    _, run = only_run(uri)
    assert run.info.run_id == run_id and run.data.params["seed"] == "3"
    strange = tracking.Journal(tmp_path / "strange")
    strange.append("run", experiment=tracking.EXPERIMENT, name="n", params={}, journal="x' OR 'x' = 'x")
    assert tracking.send_journal(strange, uri) != run_id


def test_what_a_store_is_noted_to_have_is_on_the_disk(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(tracking.Journal, "flush", lambda self: done.append("flush"))
    monkeypatch.setattr(tracking.Journal, "mark_sent", lambda *arguments: done.append("mark"))
    journal = tracking.Journal(tmp_path / "run")
    journal.append("run", experiment=tracking.EXPERIMENT, name="n", params={})
    tracking.send_journal(journal, tracking.local_uri(tmp_path))
    assert done == ["flush", "mark", "mark"]


def reports_of(caplog):
    return [record.getMessage() for record in caplog.records if record.name == tracking.__name__]


@quiet_mlflow
def test_a_server_that_never_answers_is_given_up(trainer, whole, tmp_path, caplog, monkeypatch):
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "1")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    with socket.create_server(("127.0.0.1", 0)) as silent:
        uri = f"http://127.0.0.1:{silent.getsockname()[1]}"
        trainer.train(tmp_path, SEED, Options(tracking_uri=uri))
    assert_same_end(tmp_path / "final.safetensors", whole[0] / "final.safetensors")
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


def test_files_outside_of_the_run_are_not_uploaded_whatever_a_journal_says(tmp_path, caplog):
    folder, sent = tmp_path / "run", []
    folder.mkdir()
    for path in (folder / "chart.png", tmp_path / "secret"):
        path.write_text("x")
    (folder / "link").symlink_to(tmp_path / "secret")

    class Client:
        def log_artifact(self, run_id, path, group):
            sent.append(path)

    names = ("chart.png", "../secret", str(tmp_path / "secret"), "link", "gone.png", "../run/chart.png")
    entries = [{"kind": "file", "path": name, "group": "evaluation", "time_ms": 0} for name in names]
    tracking._send_entries(Client(), "id", folder, entries)
    assert [Path(path).name for path in sent] == ["chart.png", "chart.png"]
    assert caplog.text.count("leads out of the run's folder, not uploaded") == 3
    assert "gone.png: not there any more" in caplog.text


def test_journal_is_plain_json_lines(tmp_path):
    journal = tracking.Journal(tmp_path)
    journal.append("metrics", step=1, values={"entropy": 0.5})
    (line,) = (tmp_path / tracking.JOURNAL).read_text().splitlines()
    assert json.loads(line)["values"] == {"entropy": 0.5}
