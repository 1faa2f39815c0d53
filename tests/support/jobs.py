"""Jobs that end in other ways, in a module that a worker's process imports quickly."""

import os
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
