"""The door: show a method each log of a suite, in a process of its own, and score what it says."""

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_bench.misspec.answer import (
    ANSWER,
    DONE,
    FLIGHTS,
    LOG,
    MODEL,
    READY,
    AnswerError,
    read_answer,
)
from flytrack_bench.misspec.scores import score, summarize
from flytrack_bench.misspec.suite import LogSuite, Plant
from flytrack_env.files import read_at_most, write_atomically
from flytrack_env.model_file import save_model
from flytrack_env.npz_file import npz_of
from flytrack_env.sources import digest_of_sources
from flytrack_sysid.log_file import save_log

SCHEMA = 1
MAX_BYTES = 2**26
START_S = 300.0  # to import a method
LIMIT_S = 1800.0  # of one log
Report = Callable[[int, int], None]


class Silent(RuntimeError):
    """The process of a method ended, or said nothing within its time."""


class Worker:
    """A process in which a method answers; it is begun again after it ended or hung."""

    def __init__(self, method: str, limit_s: float):
        """limit_s: wall-clock time for one log."""
        self._method, self._limit_s = method, limit_s
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Begin the process; raises AnswerError if the method cannot be imported."""
        self._process = subprocess.Popen(
            [sys.executable, "-m", "flytrack_bench.misspec.worker", self._method],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        try:
            self._reply(START_S)
        except Silent as silent:
            raise AnswerError(f"--method: {self._method}: cannot be imported: {silent}") from silent

    def ask(self, folder: Path) -> dict[str, Any]:
        """Return the answer for the log in a folder, or the reason why there is none."""
        if self._process is None:
            self.start()
        assert self._process is not None and self._process.stdin is not None
        try:
            self._process.stdin.write(f"{folder}\n".encode())
            self._process.stdin.flush()
            self._reply(self._limit_s)
            return read_answer(read_at_most(folder / ANSWER, MAX_BYTES).decode())
        except (Silent, AnswerError, OSError) as error:
            self.stop()
            return {"reason": str(error)}

    def _reply(self, limit_s: float) -> None:
        """Wait for a line of the process."""
        assert self._process is not None and self._process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            if not selector.select(limit_s):
                raise Silent(f"took more than {limit_s:g} s")
        line = self._process.stdout.readline().decode().strip()
        if line not in (READY, DONE):
            raise Silent(f"ended with status {self._process.wait()}")

    def stop(self) -> None:
        """End the process and what it has started."""
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):  # it has ended, and left nothing behind
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.communicate()
            self._process = None


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
    worker, lines = Worker(method, limit_s), found["logs"]
    remaining = [log_id for log_id in ids if log_id not in lines]
    try:
        if remaining:
            worker.start()
        for number, log_id in enumerate(remaining):
            report(number, len(remaining))
            plant = suite.plant(log_id)
            with tempfile.TemporaryDirectory() as name:
                show(plant, Path(name))
                lines[log_id] = score(plant, worker.ask(Path(name)))
            found["logs"] = dict(sorted(lines.items()))
            found["summary"] = summarize(list(found["logs"].values()))
            if out is not None:
                write_atomically(out, (json.dumps(found, indent=1) + "\n").encode())
        report(len(remaining), len(remaining))
    finally:
        worker.stop()
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
