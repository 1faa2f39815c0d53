"""MLflow tracking of a run, which goes on without it when the store cannot be reached.

MLflow is imported when a run is tracked. The id of a folder's MLflow run is in ``mlflow_run.json``, so that a
resumed training continues the same run; steps that the store has are not recorded again.
"""

import json
import logging
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from flytrack_env.files import write_atomically

RUN_FILE = "mlflow_run.json"
SQLITE = "sqlite:///"
LOCAL_STORE = "mlflow.db"
LOCAL_ARTIFACTS = "mlflow_artifacts"
LOCAL_PAGE = "http://127.0.0.1:5000"  # of `mlflow ui`
EXPERIMENT = "flytrack"
# Groups in which MLflow shows metrics; all others are of the race.
GROUPS = {
    "ppo": (
        *("policy_loss", "value_loss", "entropy", "approx_kl", "clip_fraction"),
        *("explained_variance", "learning_rate"),
    ),
    "time": ("steps_per_second",),
}
EVERY_STEP = "ppo/learning_rate"  # a metric that is recorded at every step
SEND_EVERY_S = 5.0  # a transaction of the store costs as much as hundreds of values in it
RETRY_EVERY_S = 60.0
STEPS_AT_ONCE = 16  # their metrics are one transaction: a step is in the store as a whole or not at all
LONGEST_PARAM = 6000
# A server that is down should cost seconds, where MLflow's own settings are minutes; and no telemetry.
SETTINGS = {
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
    "MLFLOW_DISABLE_TELEMETRY": "true",
}

logger = logging.getLogger(__name__)


def local_uri(folder: Path) -> str:
    """Return the address of the SQLite store in a folder."""
    return f"{SQLITE}{(folder / LOCAL_STORE).resolve()}"


def has_moved(uri: str) -> bool:
    """Return whether a store is an SQLite file that is not where it was."""
    return uri.startswith(SQLITE) and not Path(uri.removeprefix(SQLITE)).exists()


def grouped(name: str) -> str:
    """Return a metric's name in MLflow: group/name."""
    group = next((group for group, names in GROUPS.items() if name in names), "race")
    return f"{group}/{name}"


def flatten(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield nested JSON values as dotted names and texts, as MLflow's parameters are."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from flatten(value, f"{prefix}{name}.")
        else:
            text = value if isinstance(value, str) else json.dumps(value)
            yield f"{prefix}{name}", text[:LONGEST_PARAM]


class Tracker:
    """The MLflow run of a training; without a store, nothing is recorded.

    A store that cannot be reached is a warning: values are kept in memory and sent when it is back.

    Args:
        folder: of the run. uri: of the store, "" for none. name: of the MLflow run. params: JSON values.
    """

    def __init__(self, folder: Path, uri: str, name: str, params: dict[str, Any]):
        self._folder, self._uri, self._name, self._params = folder, uri, name, params
        self._client: Any = None
        self.run_id = self._experiment_id = ""
        self._last_step = -1  # that the store has
        self._metrics: list[tuple[int, int, dict[str, float]]] = []  # step, time in ms, values
        self._files: list[tuple[Path, str]] = []
        self._has_warned, self._next_s, self._retry_s = False, 0.0, 0.0

    def begin(self) -> None:
        """Create the MLflow run, or continue that of the folder."""
        self._attempt(self._connect)

    @property
    def address(self) -> str:
        """Where the run is shown: its page on a server, or how to serve a local store and then its page."""
        page = f"/#/experiments/{self._experiment_id}/runs/{self.run_id}"
        if self._uri.startswith("http"):
            return self._uri.rstrip("/") + page
        return f"{LOCAL_PAGE}{page} after `mlflow ui --backend-store-uri {self._uri}`"

    def metrics(self, step: int, values: dict[str, float]) -> None:
        """Record metrics after a number of environment steps; all of a step at once."""
        if self._uri:
            self._metrics.append((step, int(time.time() * 1000), values))
        if time.monotonic() > self._next_s:
            self.flush()

    def file(self, path: Path, group: str) -> None:
        """Record a file; group: folder of the artifacts."""
        if self._uri:
            self._files.append((path, group))

    def flush(self) -> None:
        """Send all that is pending: before a checkpoint, because a resumed run does not repeat it."""
        self._attempt(self._send)

    def end(self, status: str) -> None:
        """Send all that is pending and how the run ended: FINISHED, FAILED or KILLED."""
        self._retry_s = 0.0
        self.flush()
        self._attempt(lambda: self._client.set_terminated(self.run_id, status))
        if self.run_id:
            print(f"MLflow: {self.address}")
        if self._metrics or self._files:
            logger.warning("tracking: %s: %d steps were not recorded", self._uri, len(self._metrics))

    def _attempt(self, send: Callable[[], None]) -> None:
        if not self._uri or time.monotonic() < self._retry_s:
            return
        try:
            send()
        except Exception as error:  # whatever a store or its client raises, training goes on
            self._retry_s = time.monotonic() + RETRY_EVERY_S
            if not self._has_warned:
                reason = str(error).split("\n")[0]
                message = "tracking: %s cannot be used: %s: %s; training goes on"
                logger.warning(message, self._uri, type(error).__name__, reason)
            self._has_warned = True
        self._next_s = time.monotonic() + SEND_EVERY_S

    def _connect(self) -> None:
        for name, value in SETTINGS.items():
            os.environ.setdefault(name, value)
        from mlflow import MlflowClient

        for name in ("mlflow", "alembic"):
            logging.getLogger(name).setLevel(logging.WARNING)
        client = MlflowClient(tracking_uri=self._uri)
        known = self._read_run_id()
        self.run_id = known or self._create_run(client)
        if known is None:
            content = json.dumps({"uri": self._uri, "run_id": self.run_id})
            write_atomically(self._folder / RUN_FILE, content.encode())
        else:
            client.update_run(known, status="RUNNING")
            history = client.get_metric_history(known, EVERY_STEP)
            self._last_step = max((metric.step for metric in history), default=-1)
        self._client, self._experiment_id = client, client.get_run(self.run_id).info.experiment_id
        print(f"MLflow: {self.address}")

    def _read_run_id(self) -> str | None:
        path = self._folder / RUN_FILE
        if not path.exists():
            return None
        known = json.loads(path.read_bytes())
        return known["run_id"] if known["uri"] == self._uri or has_moved(known["uri"]) else None

    def _create_run(self, client: Any) -> str:
        from mlflow.entities import Param

        experiment = client.get_experiment_by_name(EXPERIMENT)
        if experiment is not None:
            experiment_id = experiment.experiment_id
        else:
            # MLflow would put the files of a local store into the working directory.
            store = Path(self._uri.removeprefix(SQLITE)).resolve()
            location = (store.parent / LOCAL_ARTIFACTS).as_uri() if self._uri.startswith(SQLITE) else None
            experiment_id = client.create_experiment(EXPERIMENT, artifact_location=location)
        run_id: str = client.create_run(experiment_id, run_name=self._name).info.run_id
        client.log_batch(run_id, params=[Param(*pair) for pair in flatten(self._params)])
        return run_id

    def _send(self) -> None:
        from mlflow.entities import Metric

        if self._client is None:
            self._connect()
        while self._metrics:
            metrics = [
                Metric(grouped(name), value, time_ms, step)
                for step, time_ms, values in self._metrics[:STEPS_AT_ONCE]
                if step > self._last_step
                for name, value in values.items()
            ]
            self._client.log_batch(self.run_id, metrics=metrics)
            del self._metrics[:STEPS_AT_ONCE]
        while self._files:
            path, group = self._files[0]
            self._client.log_artifact(self.run_id, str(path), group)
            del self._files[0]
