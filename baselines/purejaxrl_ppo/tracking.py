"""MLflow tracking of a run, which goes on without it when the store cannot be reached.

MLflow is imported when a run is tracked. The id of a folder's MLflow run is in ``mlflow_run.json``,
so that a resumed training continues the same run; steps that the store has are not recorded again.
"""

import json
import logging
import os
import time
from pathlib import Path
from typing import Any, NamedTuple

from baselines.purejaxrl_ppo.checkpoint import flatten
from flytrack_env.files import write_atomically

RUN_FILE = "mlflow_run.json"
LOCAL = "local"  # tracking URI: an SQLite file in the folder of the run
SQLITE, LOCAL_STORE, LOCAL_ARTIFACTS = "sqlite:///", "mlflow.db", "mlflow_artifacts"
LOCAL_PAGE = "http://127.0.0.1:5000"  # of `mlflow ui`
EXPERIMENT = "flytrack"
METRICS_TAB = "model-metrics"  # of a run's page
DENSITY, DENSITY_FILES = "density", "position_density"  # key of the charts; how their files begin
# Groups in which MLflow shows metrics; all others are of the race.
GROUPS = {
    **dict.fromkeys(("policy_loss", "value_loss", "entropy", "approx_kl", "clip_fraction"), "ppo"),
    **dict.fromkeys(("state_error", "explained_variance", "learning_rate"), "ppo"),
    "steps_per_second": "time",
}
EVERY_STEP = "ppo/learning_rate"  # a metric that is recorded at every step
SEND_EVERY_S = 5.0  # a transaction of the store costs as much as hundreds of values in it
RETRY_EVERY_S = 60.0
# their metrics are one transaction: a step is in the store as a whole or not at all
RECORDS_AT_ONCE = 16
MAX_PARAM_LENGTH = 6000
# A server that is down should cost seconds, where MLflow's own settings are minutes; and no
# telemetry.
SETTINGS = {
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
    "MLFLOW_DISABLE_TELEMETRY": "true",
}

logger = logging.getLogger(__name__)


class Record(NamedTuple):
    """What a run records at a step.

    Attributes:
        step: environment steps so far.
        time_ms: when, since 1970.
        values: metrics by name.
        files: with the folders of MLflow's artifacts that they go to.
    """

    step: int
    time_ms: int
    values: dict[str, float]
    files: list[tuple[Path, str]]


def local_uri(folder: Path) -> str:
    """Return the address of the SQLite store in a folder."""
    return f"{SQLITE}{(folder / LOCAL_STORE).resolve()}"


def describe_params(description: dict[str, Any]) -> dict[str, str]:
    """Return the description of a run as MLflow's parameters: dotted names and texts."""
    texts = {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in flatten({**description, "observation": None}).items()
    }
    return {name: text[:MAX_PARAM_LENGTH] for name, text in texts.items()}


class Tracker:
    """The MLflow run of a training.

    A store that cannot be reached is a warning: records are kept in memory and sent when it is
    back.

    Args:
        folder: of the run; its MLflow run is continued, if it has one.
        uri: of the store; "local" for an SQLite file in the folder, "" for none.
        name: of the MLflow run.
        description: of the run, as JSON values.
        parent: id of the MLflow run that a new one is below; "" for none.
    """

    def __init__(
        self, folder: Path, uri: str, name: str, description: dict[str, Any], parent: str = ""
    ):
        self._parent = parent
        self._folder, self._name, self._description = folder, name, description
        path = folder / RUN_FILE
        known = json.loads(path.read_bytes()) if path.exists() else {"uri": LOCAL, "run_id": ""}
        is_known = uri in (LOCAL, known["uri"])
        self._asked, self.run_id = (known["uri"], known["run_id"]) if is_known else (uri, "")
        self._uri = local_uri(folder) if self._asked == LOCAL else self._asked
        self._client: Any = None
        self._last_step = -1  # that the store has
        self._pending: list[Record] = []
        self._has_warned, self._next_s, self._retry_s, self._status = False, 0.0, 0.0, ""
        self.flush()

    def record(self, step: int, values: dict[str, float], files: list[tuple[Path, str]]) -> None:
        """Record metrics and files after a number of environment steps."""
        if self._uri:
            self._pending.append(Record(step, int(time.time() * 1000), values, files))
            if time.monotonic() > self._next_s:
                self.flush()

    def flush(self) -> None:
        """Send all that is pending.

        Called before a checkpoint, because a resumed run does not repeat it.
        """
        if not self._uri or time.monotonic() < self._retry_s:
            return
        self._next_s = time.monotonic() + SEND_EVERY_S
        try:
            if self._client is None:
                self._connect()
            while self._pending:
                self._send(self._pending[:RECORDS_AT_ONCE])
                del self._pending[:RECORDS_AT_ONCE]
            if self._status:
                self._client.set_terminated(self.run_id, self._status)
        except Exception as error:  # whatever a store or its client raises, training goes on
            self._retry_s = time.monotonic() + RETRY_EVERY_S
            if not self._has_warned:
                message = "tracking: %s cannot be used: %s: %s; training goes on"
                logger.warning(message, self._uri, type(error).__name__, str(error).split("\n")[0])
            self._has_warned = True

    def end(self, status: str) -> None:
        """Send all that is pending and how the run ended: FINISHED, FAILED or KILLED."""
        self._status, self._retry_s = status, 0.0
        self.flush()
        if self._pending:
            num_steps = sum(bool(record.values) for record in self._pending)
            logger.warning("tracking: %s: %d steps were not recorded", self._uri, num_steps)

    def _connect(self) -> None:
        for name, value in SETTINGS.items():
            os.environ.setdefault(name, value)
        from mlflow import MlflowClient

        for name in ("mlflow", "alembic"):
            logging.getLogger(name).setLevel(logging.WARNING)
        client = MlflowClient(tracking_uri=self._uri)
        if self.run_id:
            client.update_run(self.run_id, status="RUNNING")
            history = client.get_metric_history(self.run_id, EVERY_STEP)
            self._last_step = max((metric.step for metric in history), default=-1)
        else:
            self._create_run(client)
        self._client = client
        experiment_id = client.get_run(self.run_id).info.experiment_id
        page = f"/#/experiments/{experiment_id}/runs/{self.run_id}/{METRICS_TAB}"
        if self._uri.startswith("http"):
            print(f"MLflow: {self._uri.rstrip('/')}{page}")
        else:
            print(f"MLflow: {LOCAL_PAGE}{page} after `mlflow ui --backend-store-uri {self._uri}`")

    def _create_run(self, client: Any) -> None:
        from mlflow.entities import Param

        experiment = client.get_experiment_by_name(EXPERIMENT)
        if experiment is not None:
            experiment_id = experiment.experiment_id
        else:
            # MLflow would put the files of a local store into the working directory.
            store = Path(self._uri.removeprefix(SQLITE)).resolve()
            location = (
                (store.parent / LOCAL_ARTIFACTS).as_uri() if self._uri.startswith(SQLITE) else None
            )
            experiment_id = client.create_experiment(EXPERIMENT, artifact_location=location)
        tags = {"mlflow.parentRunId": self._parent} if self._parent else {}
        run = client.create_run(experiment_id, tags=tags, run_name=self._name)
        self.run_id = run.info.run_id
        params = [Param(*pair) for pair in describe_params(self._description).items()]
        client.log_batch(self.run_id, params=params)
        content = json.dumps({"uri": self._asked, "run_id": self.run_id})
        write_atomically(self._folder / RUN_FILE, content.encode())

    def _send(self, records: list[Record]) -> None:
        from mlflow.entities import Metric
        from PIL import Image  # which matplotlib brings

        metrics = [
            Metric(f"{GROUPS.get(name, 'race')}/{name}", value, record.time_ms, record.step)
            for record in records
            if record.step > self._last_step
            for name, value in record.values.items()
        ]
        self._client.log_batch(self.run_id, metrics=metrics)
        for record in records:
            for path, folder in record.files:
                self._client.log_artifact(self.run_id, str(path), folder)
                if path.name.startswith(DENSITY_FILES):
                    with Image.open(path) as chart:  # shown among the metrics, with a slider
                        step, time_ms = record.step, record.time_ms
                        self._client.log_image(
                            self.run_id, chart, key=DENSITY, step=step, timestamp=time_ms
                        )


def end_unfinished(folder: Path, uri: str) -> None:
    """Tell MLflow that the run of a folder was ended, if its process could not."""
    path = folder / RUN_FILE
    if not uri or not path.exists():
        return
    from mlflow import MlflowClient

    client, run_id = MlflowClient(tracking_uri=uri), json.loads(path.read_bytes())["run_id"]
    if client.get_run(run_id).info.status == "RUNNING":
        client.set_terminated(run_id, "KILLED")
