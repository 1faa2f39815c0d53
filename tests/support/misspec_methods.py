"""Methods for the door of misspec-v1 that answer, crash, invent a name, and hang, in this order."""

import time

from flytrack_bench.misspec import Answer

calls = 0


def moody(log, model):
    global calls
    calls += 1
    print("a method may print")
    if calls == 2:
        raise ZeroDivisionError("by design")
    if calls == 3:
        return Answer(names=("gremlins",))
    if calls == 4:
        time.sleep(1e6)
    return Answer(names=("linear_drag",), flagged=True, model=None)
