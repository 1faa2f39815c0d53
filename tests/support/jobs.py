"""Jobs that end in other ways, in a module that a worker's process imports quickly."""

import os
import subprocess
import time


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
