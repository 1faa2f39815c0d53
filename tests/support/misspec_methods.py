"""Methods for the door of misspec-v1 that misbehave."""

import os

from flytrack_bench.misspec import Answer

calls = 0


def moody(log, model):
    """Answer, crash, invent a name, and end the process, in this order."""
    global calls
    calls += 1
    print("a method may print")
    if calls == 2:
        raise ZeroDivisionError("by design")
    if calls == 3:
        return Answer(names=("gremlins",))
    if calls == 4:
        os._exit(3)
    return Answer(names=("linear_drag",), flagged=True)
