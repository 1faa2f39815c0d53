"""Jobs that end in other ways, in a module that a worker's process imports quickly."""

import os
import subprocess
import time
from typing import NamedTuple


class Trial(NamedTuple):
    """What a benchmark measures: how a job ends."""

    kind: str
    number: int = 0


def measure(trial):
    """Return what is measured of a trial."""
    return {"found": end_as(trial.kind)}


def end_as(kind):
    """Crash, hang, raise, or return the kind."""
    if kind == "crash":
        os._exit(3)
    if kind == "hang":
        time.sleep(600)
    if kind == "raise":
        raise ValueError("no such thing")
    return kind


def start_child(path):
    """Print, start a process, write its id, and hang."""
    print("a job may print", flush=True)
    path.write_text(str(subprocess.Popen(["sleep", "600"]).pid))
    time.sleep(600)
