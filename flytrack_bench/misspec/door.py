"""The door: show a method each log of a suite, in a process of its own, and score what it says."""

import json
import tempfile
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_bench.misspec.answer import FLIGHTS, LOG, MODEL, AnswerError
from flytrack_bench.misspec.scores import score, summarize
from flytrack_bench.misspec.suite import LogSuite, Plant
from flytrack_bench.misspec.worker import answer_folder, load_method
from flytrack_env.files import read_at_most, write_atomically
from flytrack_env.jobs import Worker
from flytrack_env.model_file import save_model
from flytrack_env.npz_file import npz_of
from flytrack_env.sources import digest_of_sources
from flytrack_sysid.log_file import save_log

SCHEMA = 1
MAX_BYTES = 2**26
START_S = 300.0  # to import a method
LIMIT_S = 1800.0  # of one log
Report = Callable[[int, int], None]


def ask(worker: Worker, method: str, folder: Path, limit_s: float) -> dict[str, Any]:
    """Return a method's answer for the log in a folder, or the reason why there is none.

    Raises:
        AnswerError: the method cannot be imported.
    """
    if worker.process is None:  # new, or ended by the last log
        outcome = worker.call(load_method, (method,), START_S)
        if outcome.error:
            raise AnswerError(outcome.error)
    outcome = worker.call(answer_folder, (method, folder), limit_s)
    if outcome.error:
        return {"reason": outcome.error.replace(f"{folder}/", "")}  # it is a temporary one
    answer: dict[str, Any] = outcome.value
    return answer


def show(plant: Plant, folder: Path) -> None:
    """Write what a method is given of a plant into a folder."""
    save_log(folder / LOG, plant.log)
    save_model(folder / MODEL, plant.model, {})
    flights = {"step_s": np.array(plant.flights.step_s), "commands": plant.flights.commands}
    write_atomically(folder / FLIGHTS, npz_of(flights | plant.flights.past))


def run_method(
    suite: LogSuite,
    ids: Sequence[str],
    method: str,
    out: Path | None,
    limit_s: float,
    report: Report = lambda done, total: None,
) -> dict[str, Any]:
    """Return the result of a method on logs, as JSON values.

    Args:
        suite: of the logs.
        ids: of the logs.
        method: ``module:function``.
        out: file of the result, written after each log; what it has already is not asked again.
        limit_s: wall-clock time for one log.
        report: called with logs done and to do.
    """
    found = begun(suite, method, out)
    worker, lines = Worker(), found["logs"]
    remaining = [log_id for log_id in ids if log_id not in lines]
    try:
        for number, log_id in enumerate(remaining):
            report(number, len(remaining))
            plant = suite.plant(log_id)
            with tempfile.TemporaryDirectory() as name:
                show(plant, Path(name))
                lines[log_id] = score(plant, ask(worker, method, Path(name), limit_s))
            found["logs"] = dict(sorted(lines.items()))
            found["summary"] = summarize(list(found["logs"].values()))
            if out is not None:
                write_atomically(out, (json.dumps(found, indent=1) + "\n").encode())
        report(len(remaining), len(remaining))
    finally:
        worker.end()
    return found


def begun(suite: LogSuite, method: str, out: Path | None) -> dict[str, Any]:
    """Return the result so far, from its file where there is one.

    Raises:
        AnswerError: the file is of another suite, method or code, or no result.
    """
    head = {"schema": SCHEMA, "suite": suite.name, "digest": suite.digest, "method": method}
    head["code"] = digest_of_sources()
    head["versions"] = {name: version(name) for name in ("flytrack", "jax", "numpy", "scipy")}
    if out is None or not out.exists():
        return {**head, "logs": {}, "summary": {}}
    try:
        found: dict[str, Any] = json.loads(read_at_most(out, MAX_BYTES))
        if not isinstance(found["logs"], dict):
            raise TypeError("logs: expected an object")
    except (ValueError, KeyError, TypeError) as error:
        raise AnswerError(f"--out: {out}: not a result: {error}") from error
    for name, expected in head.items():
        if found.get(name) != expected:
            raise AnswerError(f"--out: {out}: {name}: found {found.get(name)}, expected {expected}")
    return found
