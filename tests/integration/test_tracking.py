"""MLflow tracking: everything is recorded once, and training goes on without a server."""

import pytest

from baselines.purejaxrl_ppo import load_checkpoint, monitor, tracking
from baselines.purejaxrl_ppo.training import Options
from flytrack_env.rollout import load_rollout
from tests.support.ppo_runs import BATCH, DEAD_URI, ENV_ID, SEED, assert_same_end

METRICS = {"race/episode_return", "race/episode_crash", "race/evaluation_success"}
METRICS |= {"ppo/policy_loss", "ppo/learning_rate", "time/steps_per_second"}

pytestmark = pytest.mark.filterwarnings("default")  # deprecations in MLflow's own dependencies


def only_run(uri):
    from mlflow import MlflowClient

    client = MlflowClient(tracking_uri=uri)
    experiment = client.get_experiment_by_name(tracking.EXPERIMENT)
    (run,) = client.search_runs([experiment.experiment_id])
    return client, run


def history(client, run, name):
    return [
        (metric.step, metric.value) for metric in client.get_metric_history(run.info.run_id, name)
    ]


def reports_of(caplog):
    return [record.getMessage() for record in caplog.records if record.name == tracking.__name__]


@pytest.mark.slow
def test_everything_is_recorded_once_though_the_run_was_cut_off(
    trainer, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(monitor, "NUM_STEPS", 20)
    uri = tracking.local_uri(tmp_path)
    options = Options(
        2 * BATCH, evaluate_every=4 * BATCH, evaluation_episodes=2, tracking_uri="local"
    )
    trainer.train(tmp_path, SEED, options)
    client, run = only_run(uri)
    page = f"/#/experiments/{run.info.experiment_id}/runs/{run.info.run_id}/model-metrics after"
    assert capsys.readouterr().out.count(page) == 1
    description = load_checkpoint(tmp_path / "final.safetensors").meta
    parts = {part: description[part] for part in ("config", "environment", "model")}
    expected = tracking.describe_params(parts) | {"seed": str(SEED), "env_id": ENV_ID}
    assert expected.items() <= run.data.params.items()
    assert set(run.data.metrics) >= METRICS
    before = history(client, run, "ppo/policy_loss")
    assert [step for step, _ in before] == [2 * BATCH, 4 * BATCH, 6 * BATCH, 7 * BATCH]
    assert [step for step, _ in history(client, run, "race/evaluation_success")] == [
        4 * BATCH,
        7 * BATCH,
    ]
    names = {file.path for file in client.list_artifacts(run.info.run_id, "evaluation")}
    assert f"evaluation/position_density_{7 * BATCH}.png" in names
    charts = [file.path for file in client.list_artifacts(run.info.run_id, "images")]
    shown = {path for path in charts if path.endswith(".png") and path.startswith("images/density")}
    assert len(shown) == 2  # one of each evaluation
    assert f"evaluation/rollout_{4 * BATCH}.npy" in names
    assert len(client.list_artifacts(run.info.run_id, "checkpoints")) == 5
    load_rollout(tmp_path / "evaluation" / f"rollout_{7 * BATCH}.npy")

    # Killed after the checkpoint at 4; and the folder was moved.
    for name in ("final.safetensors", f"step_{6 * BATCH}.safetensors"):
        (tmp_path / name).unlink()
    trainer.train(tmp_path, SEED, options, tmp_path)
    client, run = only_run(uri)
    assert run.info.status == "FINISHED" and history(client, run, "ppo/policy_loss") == before


@pytest.mark.slow
def test_a_server_that_is_down_does_not_end_the_training(trainer, whole, tmp_path, caplog):
    trainer.train(tmp_path, SEED, Options(2 * BATCH, tracking_uri=DEAD_URI))
    assert_same_end(tmp_path / "final.safetensors", whole[0] / "final.safetensors")
    reports = reports_of(caplog)
    assert len(reports) == 2 and DEAD_URI in reports[0] and "training goes on" in reports[0]
    assert "4 steps were not recorded" in reports[1]


def test_a_server_that_comes_back_gets_what_it_missed(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(tracking, "RETRY_EVERY_S", 0.0)
    connect = tracking.Tracker._connect

    def fail(self):
        raise ConnectionError("gone")

    monkeypatch.setattr(tracking.Tracker, "_connect", fail)
    uri = tracking.local_uri(tmp_path)
    tracker = tracking.Tracker(tmp_path, uri, "name", {"seed": 3})
    for step in (1, 2):
        tracker.record(step, {"learning_rate": 0.5 * step}, [])
    monkeypatch.setattr(tracking.Tracker, "_connect", connect)
    tracker.end("FINISHED")
    client, run = only_run(uri)
    assert history(client, run, tracking.EVERY_STEP) == [(1, 0.5), (2, 1.0)]
    assert run.info.status == "FINISHED" and run.data.params["seed"] == "3"
    (report,) = reports_of(caplog)
    assert "ConnectionError: gone" in report
