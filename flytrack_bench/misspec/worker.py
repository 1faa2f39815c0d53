"""The process in which a method runs: it has the log and the nominal model, and no truth.

``python -m flytrack_bench.misspec.worker MODULE:FUNCTION`` reads a folder's name from each line of
its standard input, and writes ``answer.json`` into it. What a method prints goes to stderr.
"""

import json
import os
import resource
import sys
import time
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from flytrack_bench.misspec.answer import (
    ANSWER,
    DONE,
    FLIGHTS,
    LOG,
    MODEL,
    READY,
    Answer,
    AnswerError,
)
from flytrack_bench.misspec.suite import Flights
from flytrack_env.compile_cache import keep_compiled_programs
from flytrack_env.extras import import_object
from flytrack_env.files import write_atomically
from flytrack_env.model_file import load_model
from flytrack_env.npz_file import load_npz
from flytrack_sysid.log_file import load_log

MAX_BYTES = 2**26  # of flights


def main(method_name: str, replies: TextIO) -> None:
    """Answer for each folder that is named on standard input."""
    keep_compiled_programs()
    method = import_object(method_name, "--method", AnswerError)
    print(READY, file=replies, flush=True)
    for line in sys.stdin:
        folder = Path(line.rstrip("\n"))
        try:
            answer = answer_of(method, folder)
        except Exception as error:  # whatever a method raises
            reason = f"{type(error).__name__}: {error}"
            answer = {"reason": reason.replace(f"{folder}/", "")}  # it is a temporary one
        write_atomically(folder / ANSWER, json.dumps(answer).encode())
        print(DONE, file=replies, flush=True)


def answer_of(method: Any, folder: Path) -> dict[str, Any]:
    """Return a method's answer as JSON values, with the CPU seconds of the method alone."""
    log, model = load_log(folder / LOG), load_model(folder / MODEL)
    started_s = cpu_s()
    answer = method(log, model)
    seconds = cpu_s() - started_s
    if not isinstance(answer, Answer):
        raise AnswerError(f"method: found {type(answer).__name__}, expected a misspec.Answer")
    return answer.as_json(read_flights(folder / FLIGHTS)) | {"cpu_s": round(seconds, 2)}


def cpu_s() -> float:
    """Return the CPU seconds of this process and of the children that have ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def read_flights(path: Path) -> Flights:
    """Return the flights in a file that the door wrote."""
    arrays: dict[str, np.ndarray] = dict(load_npz(path, MAX_BYTES))
    step_s, commands = float(arrays.pop("step_s")), arrays.pop("commands")
    return Flights(step_s, arrays, commands)


if __name__ == "__main__":
    # A method may print: only this process writes to the door's end of the pipe.
    to_door = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    main(sys.argv[1], to_door)
