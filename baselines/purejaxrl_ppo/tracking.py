"""MLflow tracking: what a run tells, kept in a journal, so that nothing is lost while no server listens.

Everything is first written to ``tracking.jsonl`` in the run's folder, one entry a line, and then sent.
A server that does not answer ends the sending, not the training; what was not sent is sent by
``python -m baselines.purejaxrl_ppo.tracking FOLDER --tracking-uri URI``, now or next week. Entries carry
their time, so that one that is sent twice is one. MLflow is imported when the first entry is sent.
"""

import argparse
import json
import logging
import os
import secrets
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from baselines.purejaxrl_ppo.journal import JOURNAL, SQLITE, Journal, JournalError
from flytrack_env.messages import quote_name

LOCAL_STORE = "mlflow.db"
LOCAL_ARTIFACTS = "mlflow_artifacts"
EXPERIMENT = "flytrack"
SEND_EVERY_S = 5.0  # a transaction of the store costs as much as hundreds of values in it
ENTRIES_AT_ONCE = 32
PARAMS_AT_ONCE = 100  # MLflow's limits
METRICS_AT_ONCE = 1000
LONGEST_PARAM = 6000
JOURNAL_TAG = "flytrack.journal"  # by which a run is found again that a kill left without a note of its id
MLFLOW_PARENT = "mlflow.parentRunId"  # the tag by which MLflow shows a run below another
# A server that is down shall cost seconds, where MLflow's own settings are minutes; and no telemetry.
QUIET = {
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
    "MLFLOW_DISABLE_TELEMETRY": "true",
}

logger = logging.getLogger(__name__)


def local_uri(folder: Path) -> str:
    """Return the address of the SQLite store in a folder."""
    return f"{SQLITE}{(folder / LOCAL_STORE).resolve()}"


class Tracker:
    """Tells an MLflow store of a run, and goes on without where that fails.

    A run that is taken up again in the same folder goes on in the same MLflow run; what it tells a
    second time, because it was killed after its last checkpoint, is not told again.

    Args:
        folder: of the run; files that are told of are in it. uri: of the store. name: of the MLflow run.
        params: of the run, nested JSON values. parent: folder of the run that this is a part of, if any.
    """

    def __init__(self, folder: Path, uri: str, name: str, params: dict[str, Any], parent: Path | None = None):
        self.journal, self.uri = Journal(folder), uri
        self._is_listening, self._last_sent_s = True, -SEND_EVERY_S
        if not self.journal.of_kind("run"):
            above = {} if parent is None else {"parent": os.path.relpath(parent, folder)}
            own = {"journal": secrets.token_hex(8)}
            self.journal.append("run", experiment=EXPERIMENT, name=name, params=params, **own, **above)
        self._last_step = max((entry["step"] for entry in self.journal.of_kind("metrics")), default=-1)
        self._told = {entry["path"] for entry in self.journal.of_kind("file")}

    def begin(self) -> None:
        """Tell that the run is under way."""
        self.journal.append("status", status="RUNNING")
        self.send()

    def has_ended(self, status: str) -> bool:
        """Return whether this is how the run was last told to have ended."""
        told = self.journal.of_kind("status")
        return bool(told) and told[-1]["status"] == status

    def keep(self) -> None:
        """Have all that was told on the disk: before a checkpoint, which a run goes on from, says it was."""
        self.journal.flush()

    def metrics(self, step: int, values: dict[str, float]) -> None:
        """Tell metrics after a number of environment steps; all of a step at once."""
        if step <= self._last_step:
            return
        self.journal.append("metrics", step=step, values=values)
        self._last_step = step
        if time.monotonic() - self._last_sent_s > SEND_EVERY_S:
            self.send()

    def file(self, path: Path, group: str) -> None:
        """Tell of a file in the run's folder; group: folder of the artifacts."""
        name = str(path.relative_to(self.journal.folder))
        if name not in self._told:
            self._told.add(name)
            self.journal.append("file", path=name, group=group)

    def end(self, status: str) -> None:
        """Tell how the run ended, FINISHED, FAILED or KILLED, and send what is left."""
        self.journal.append("status", status=status)
        self.send()

    def send(self, journal: Journal | None = None) -> None:
        """Send what was not sent; the first time that it fails, warn and stop sending.

        journal: of a part of this run; None: its own.
        """
        if not self._is_listening:
            return
        try:
            send_journal(journal or self.journal, self.uri)
        except Exception as error:  # whatever a store or its client raises, training goes on
            self._is_listening = False
            logger.warning(
                "tracking: %s cannot be used: %s: %s. Training goes on; what it tells is kept in %s. "
                "Upload it later with: python -m baselines.purejaxrl_ppo.tracking %s --tracking-uri %s",
                self.uri,
                type(error).__name__,
                str(error).split("\n")[0],
                self.journal.path,
                self.journal.folder,
                self.uri,
            )
        self._last_sent_s = time.monotonic()


def flatten(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield nested JSON values as dotted names and texts, as MLflow's parameters are."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from flatten(value, f"{prefix}{name}.")
        else:
            text = value if isinstance(value, str) else json.dumps(value)
            yield f"{prefix}{name}", text[:LONGEST_PARAM]


def send_journal(journal: Journal, uri: str) -> str:
    """Send what a store has not got of a journal, and return the run's id in it.

    Raises:
        JournalError: a journal that says nothing of a run.
        Exception: whatever MLflow and the store raise; what was sent before that is noted.
    """
    beginning = journal.beginning()
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    from mlflow import MlflowClient

    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    client = MlflowClient(tracking_uri=uri)
    journal.flush()  # else a loss of power can leave notes of entries that are gone, and keep new ones back
    run_id, count = journal.sent(uri)
    if run_id is None:
        run_id = _create_run(client, uri, beginning, parent_of(journal, uri))
        journal.mark_sent(uri, run_id, 0)
    while count < len(journal.entries):
        entries = journal.entries[count : count + ENTRIES_AT_ONCE]
        _send_entries(client, run_id, journal.folder, entries)
        count += len(entries)
        journal.mark_sent(uri, run_id, count)
    return run_id


def parent_of(journal: Journal, uri: str) -> str | None:
    """Return the id in a store of the run that a journal's run is a part of; None for a run by itself.

    Raises:
        JournalError: the store does not know that run.
    """
    parent = journal.beginning().get("parent")
    if parent is None:
        return None
    folder = (journal.folder / str(parent)).resolve()
    run_id, _ = Journal(folder).sent(uri)
    if run_id is None:
        raise JournalError(
            f"{journal.path}: a part of {folder}, which {uri} was not told of; upload it first"
        )
    return run_id


def _create_run(client: Any, uri: str, entry: dict[str, Any], parent: str | None) -> str:
    """Create the run of a journal, and its experiment, where there is none, and return the run's id."""
    found = client.get_experiment_by_name(entry["experiment"])
    if found is not None:
        experiment_id = found.experiment_id
    elif uri.startswith(SQLITE):
        # MLflow would put the files of a local store wherever the command was typed.
        folder = Path(uri.removeprefix(SQLITE)).resolve().parent / LOCAL_ARTIFACTS
        experiment_id = client.create_experiment(entry["experiment"], artifact_location=folder.as_uri())
    else:
        experiment_id = client.create_experiment(entry["experiment"])
    tags = {} if parent is None else {MLFLOW_PARENT: parent}
    name = entry.get("journal")
    if isinstance(name, str) and name.isalnum():
        known = client.search_runs([experiment_id], f"tags.`{JOURNAL_TAG}` = '{name}'")
        if known:
            return known[0].info.run_id
        tags[JOURNAL_TAG] = name
    run = client.create_run(experiment_id, start_time=entry["time_ms"], run_name=entry["name"], tags=tags)
    return run.info.run_id


def _send_entries(client: Any, run_id: str, folder: Path, entries: list[dict[str, Any]]) -> None:
    """Send entries of a journal: parameters, then all metrics, then files and status."""
    from mlflow.entities import Metric, Param

    for entry in (entry for entry in entries if entry["kind"] == "run"):
        params = [Param(name, text) for name, text in flatten(entry["params"])]
        for start in range(0, len(params), PARAMS_AT_ONCE):
            client.log_batch(run_id, params=params[start : start + PARAMS_AT_ONCE])
    metrics = [
        Metric(name, value, entry["time_ms"], entry["step"])
        for entry in entries
        if entry["kind"] == "metrics"
        for name, value in entry["values"].items()
    ]
    for start in range(0, len(metrics), METRICS_AT_ONCE):
        client.log_batch(run_id, metrics=metrics[start : start + METRICS_AT_ONCE])
    for entry in entries:
        if entry["kind"] == "file":
            _send_file(client, run_id, folder, entry)
        elif entry["kind"] == "status" and entry["status"] == "RUNNING":
            client.update_run(run_id, status="RUNNING")
        elif entry["kind"] == "status":
            client.set_terminated(run_id, entry["status"], end_time=entry["time_ms"])


def _send_file(client: Any, run_id: str, folder: Path, entry: dict[str, Any]) -> None:
    """Send a file of the run's folder, and no other: a journal may be a stranger's."""
    path = folder / entry["path"]
    if not path.resolve().is_relative_to(folder.resolve()):
        logger.warning("tracking: %s: leads out of the run's folder, not uploaded", quote_name(path))
    elif not path.exists():
        logger.warning("tracking: %s: not there any more, not uploaded", path)
    else:
        client.log_artifact(run_id, str(path), entry["group"])


def main() -> None:
    """Parse the command line and upload a run's journal."""
    parser = argparse.ArgumentParser(description="Upload what a training run told to an MLflow store.")
    parser.add_argument("folder", type=Path, help=f"folder of the run, with its {JOURNAL}")
    parser.add_argument("--tracking-uri", required=True, help="of the store: http://..., sqlite:///...")
    arguments = parser.parse_args()
    if not (arguments.folder / JOURNAL).exists():
        parser.error(f"{arguments.folder}: found no {JOURNAL}, expected the folder of a tracked run")
    try:
        journal = Journal(arguments.folder)
        run_id = send_journal(journal, arguments.tracking_uri)
    except JournalError as error:
        parser.error(str(error))
    except Exception as error:  # whatever a store or its client raises
        parser.error(f"{arguments.tracking_uri}: cannot be used: {type(error).__name__}: {error}")
    print(f"uploaded: {len(journal.entries)} entries to run {run_id} of {arguments.tracking_uri}")


if __name__ == "__main__":
    main()
