"""Has files of a kind judged by a worker process, and another one where a file ended it."""

import json
import os
import select
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

from benchmarks.reliability.strangers.watch import CPU_S
from benchmarks.reliability.strangers.worker import KINDS_MODULE

START_S, WAIT_S = (
    300.0,
    120.0,
)  # on the clock: until a worker is ready; for a load, which may wait for a trial
MOST_EXAMPLES = 10  # kept of each sort that is broken
MOST_DEATHS = 200  # of workers of a kind: what ends one so often is known by then
LONGEST_FAILURE = 600  # characters
KEPT = ("loaded", "refused")


class WorkerError(RuntimeError):
    """A worker that ended before a load, or could not make a file: a mistake in the measurement."""


class _Worker:
    """A worker that judges the files of a kind from a number on."""

    def __init__(self, command: list[str], errors: IO[bytes]):
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors)
        assert self._process.stdout is not None
        self._output = self._process.stdout
        self._rest = b""

    def line(self, wait_s: float) -> dict[str, Any] | None:
        """Return its next line; None where it has ended, or had to be: see ``death``."""
        while b"\n" not in self._rest:
            if not select.select([self._output], [], [], wait_s)[0]:
                self._process.kill()
                self._process.wait()
                return None
            part = os.read(self._output.fileno(), 2**16)
            if not part:
                self._process.wait()
                return None
            self._rest += part
        text, _, self._rest = self._rest.partition(b"\n")
        found: dict[str, Any] = json.loads(text)
        if "mistake" in found:
            raise WorkerError(found["mistake"])
        return found

    def death(self) -> tuple[str, str]:
        """Return the sort and the words of how it ended."""
        status = self._process.returncode
        if status == -signal.SIGXCPU:
            return "time", f"more than {CPU_S:g} s of processor time"
        if status == -signal.SIGKILL:
            return "time", f"no answer for {WAIT_S:g} s, or killed"
        return "crash", f"the process ended with {status}"

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()
        self._output.close()


def _command(kind: str, seed: int, first: int, last: int, folder: Path, kinds: str) -> list[str]:
    module = "benchmarks.reliability.strangers.worker"
    numbers = ["--seed", str(seed), "--first", str(first), "--last", str(last)]
    return [sys.executable, "-m", module, kind, *numbers, "--folder", str(folder), "--kinds", kinds]


def outcomes(kind: str, seed: int, count: int, folder: Path, kinds: str) -> Iterator[dict[str, Any]]:
    """Yield what came of each of a kind's files, by number; what ended a worker is one of them.

    ``is_crafted`` says which were made on purpose. kinds: the module that has the kind.

    Raises:
        WorkerError: a mistake in the measurement.
    """
    number, log = 0, folder / f"{kind}.stderr"
    for _ in range(MOST_DEATHS):
        with log.open("wb") as errors:
            worker = _Worker(_command(kind, seed, number, count, folder, kinds), errors)
        try:
            ready = worker.line(START_S)
            if ready is None:
                raise WorkerError(f"{kind}: {worker.death()}: {log.read_text(errors='replace')[-2000:]}")
            crafted = range(ready["ready"], ready["ready"] + ready["hostile"])
            while number < count:
                found = worker.line(WAIT_S)
                is_alive = found is not None
                if found is None:
                    sort, text = worker.death()
                    said = log.read_text(errors="replace").strip().splitlines() or [""]
                    found = {
                        "number": number,
                        "sort": sort,
                        "text": f"{text}: {said[-1]}"[:600],
                        "cpu_s": 0.0,
                    }
                number = found["number"] + 1
                yield {**found, "is_crafted": found["number"] in crafted}
                if not is_alive:
                    break
        finally:
            worker.close()
        if number >= count:
            return


def measure_kind(
    kind: str,
    seed: int,
    count: int,
    folder: Path,
    tell: Callable[[], object] = lambda: None,
    kinds: str = KINDS_MODULE,
) -> dict[str, Any]:
    """Return what came of a kind's files, as JSON values; ``tell`` is called after each.

    files, crafted (those of them made on purpose), loaded, refused; broken: number by sort; examples of the
    broken; failure: what ended the measurement before all were judged, None if nothing did; slowest_s and
    cpu_s, of processor time.
    """
    sorts: Counter[str] = Counter()
    examples: list[dict[str, Any]] = []
    slowest_s, cpu_s, num_crafted, failure = 0.0, 0.0, 0, None
    try:
        for found in outcomes(kind, seed, count, folder, kinds):
            sort = found["sort"]
            sorts[sort] += 1
            num_crafted += found["is_crafted"]
            if sort not in KEPT and sorts[sort] <= MOST_EXAMPLES:
                examples.append({"number": found["number"], "sort": sort, "text": found["text"]})
            slowest_s, cpu_s = max(slowest_s, found["cpu_s"]), cpu_s + found["cpu_s"]
            tell()
    except WorkerError as error:  # what was found so far, and of other kinds, is not lost
        failure = str(error)[-LONGEST_FAILURE:]
    return {
        "files": sorts.total(),
        "crafted": num_crafted,
        **{sort: sorts[sort] for sort in KEPT},
        "broken": {sort: number for sort, number in sorts.items() if sort not in KEPT},
        "examples": examples,
        "failure": failure,
        "slowest_s": round(slowest_s, 2),
        "cpu_s": round(cpu_s, 1),
    }
