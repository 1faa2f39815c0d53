"""What runs in the process of a method: it has the log and the nominal model, and no truth."""

import functools
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_bench.misspec.answer import FLIGHTS, LOG, MODEL, Answer, AnswerError
from flytrack_bench.misspec.suite import Flights
from flytrack_env.extras import import_object
from flytrack_env.model_file import load_model
from flytrack_env.npz_file import load_npz
from flytrack_sysid.log_file import load_log

MAX_BYTES = 2**26  # of flights


@functools.cache
def import_method(name: str) -> Any:
    """Return the function that ``module:function`` names; raises AnswerError if there is none."""
    return import_object(name, "--method", AnswerError)


def load_method(name: str) -> None:
    """Import a method, so that its first log does not have to."""
    import_method(name)


def answer_folder(name: str, folder: Path) -> dict[str, Any]:
    """Return a method's answer as JSON values, with the CPU seconds of the method alone."""
    log, model = load_log(folder / LOG), load_model(folder / MODEL)
    started_s = cpu_s()
    answer = import_method(name)(log, model)
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
