"""The other side of ``apart``: imports a module once, and forks a child for every call. Run as a script.

Calls come on standard input, answers go to standard output; each is a line of JSON, then as many bytes as
its ``size`` says. It ends where its input does, which is when the process that started it is gone.
"""

import importlib.util
import json
import os
import resource
import select
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

READ_BYTES = 2**16
LONGEST_TEXT = 1000  # characters of what a child says of itself: foreign files have a say in it
RETURNED, RAISED = b"R", b"E"
STATUS = Path("/proc/self/status")


def data_bytes() -> int | None:
    """Return the memory that this process has to write to, bytes; None where the system does not say."""
    if not STATUS.exists():
        return None
    lines = dict(line.split(":", 1) for line in STATUS.read_text().splitlines() if ":" in line)
    return int(lines["VmData"].split()[0]) * 1024


def _limit(kind: int, value: int) -> None:
    """Lower a limit of this process; one that is lower already stays."""
    hard = resource.getrlimit(kind)[1]
    value = value if hard == resource.RLIM_INFINITY else min(value, hard)
    resource.setrlimit(kind, (value, hard))


def limit(cpu_s: int, memory_bytes: int) -> None:
    """Bound what this process may use from here on, and let it write no file.

    Memory is bounded where the system says how much there is already: on Linux.
    """
    used_s = time.process_time()
    _limit(resource.RLIMIT_CPU, cpu_s + int(used_s))
    _limit(resource.RLIMIT_FSIZE, 0)
    _limit(resource.RLIMIT_CORE, 0)
    before = data_bytes()
    if before is not None:
        _limit(resource.RLIMIT_DATA, before + memory_bytes)


def _be_child(function: Callable[[Any, bytes], bytes], call: dict[str, Any], content: bytes) -> bytes:
    """Return what a call's child says: RETURNED and the result, or RAISED, the exception and its text."""
    try:
        limit(call["cpu_s"], call["memory_bytes"])
        return RETURNED + function(call["argument"], content)
    except BaseException as error:  # whatever it is, the other side is told
        said = {"type": type(error).__name__, "text": str(error)[:LONGEST_TEXT]}
        return RAISED + json.dumps(said).encode()


def _fork(
    function: Callable[[Any, bytes], bytes], call: dict[str, Any], content: bytes
) -> tuple[int, int, int]:
    """Return the child that runs a call, and where its result and what it says can be read."""
    result, result_end = os.pipe()
    said, said_end = os.pipe()
    child = os.fork()
    if child:
        os.close(result_end)
        os.close(said_end)
        return child, result, said
    try:
        os.set_blocking(said_end, False)  # nobody reads it before the child is gone: what is too much is lost
        os.dup2(said_end, 2)
        os.closerange(3, result_end)  # the calls, the answers, ...
        os.closerange(result_end + 1, os.sysconf("SC_OPEN_MAX"))
        with os.fdopen(result_end, "wb") as file:
            file.write(_be_child(function, call, content))
    finally:
        os._exit(0)


def _read(result: int, caller: int, most_bytes: int, deadline_s: float) -> tuple[bytes, bool]:
    """Return what a child writes until it ends, and whether it ended in time and wrote no more than that.

    caller: whence calls come; there is nothing to be read before this one is answered, but its end.
    """
    parts: list[bytes] = []
    size = 0
    while size <= most_bytes:
        ready = select.select([result, caller], [], [], max(deadline_s - time.monotonic(), 0.0))[0]
        if result not in ready:
            return b"".join(parts), False
        part = os.read(result, READ_BYTES)
        if not part:
            return b"".join(parts), True
        parts.append(part)
        size += len(part)
    return b"", False


def _how_it_ended(status: int, is_in_time: bool, said: bytes) -> dict[str, str]:
    """Return what became of a child that gave no result: ``ended``, and ``text``."""
    if not is_in_time:
        return {"ended": "late", "text": ""}
    lines = said.decode(errors="replace").strip().splitlines() or [""]
    text = lines[-1][:LONGEST_TEXT]
    if not os.WIFSIGNALED(status):
        return {"ended": "crashed", "text": f"exit status {os.waitstatus_to_exitcode(status)}: {text}"}
    number = os.WTERMSIG(status)
    if number in (signal.SIGXCPU, signal.SIGKILL):  # SIGKILL: no other process of ours sends it in time
        return {"ended": "cpu" if number == signal.SIGXCPU else "killed", "text": ""}
    return {"ended": "crashed", "text": f"{signal.Signals(number).name}: {text}"}


def serve(
    function: Callable[[Any, bytes], bytes], call: dict[str, Any], content: bytes, caller: int
) -> tuple[Any, bytes]:
    """Return the answer to a call (``ended``, ``text``), and the bytes of its result."""
    child, result, said = _fork(function, call, content)
    found, is_in_time = _read(result, caller, call["memory_bytes"], time.monotonic() + call["wall_s"])
    if not is_in_time:
        os.kill(child, signal.SIGKILL)
    status = os.waitpid(child, 0)[1]
    os.set_blocking(said, False)
    try:
        last_words = os.read(said, READ_BYTES)
    except BlockingIOError:
        last_words = b""
    os.close(result)
    os.close(said)
    if status == 0 and is_in_time and found[:1] == RETURNED:
        return {"ended": "returned", "text": ""}, found[1:]
    if status == 0 and is_in_time and found[:1] == RAISED:
        error = json.loads(found[1:])
        if (
            error["type"] == "MemoryError"
        ):  # the bound is at fault, as where the function did not live to say so
            return {"ended": "memory", "text": ""}, b""
        return {"ended": "raised", **error}, b""
    return _how_it_ended(status, is_in_time, last_words), b""


def _module(file: Path) -> Any:
    """Return the module in a file, without the package that it lies in."""
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[file.stem] = module
    spec.loader.exec_module(module)
    return module


def main(calls: BinaryIO, answers: BinaryIO) -> None:
    """Answer calls until there are no more."""
    setup = json.loads(calls.readline())
    sys.path[:] = setup["path"]
    module = _module(Path(setup["file"]))
    if hasattr(module, "prepare"):
        module.prepare()
    answers.write(b'{"ended": "ready", "size": 0}\n')
    answers.flush()
    while line := calls.readline():
        call = json.loads(line)
        content = calls.read(call["size"])
        answer, result = serve(getattr(module, setup["function"]), call, content, calls.fileno())
        answers.write(json.dumps({**answer, "size": len(result)}).encode() + b"\n" + result)
        answers.flush()


if __name__ == "__main__":
    # What functions print must not come between the answers, and nothing of theirs reads the calls.
    calls, answers = open(os.dup(0), "rb"), open(os.dup(1), "wb")  # noqa: SIM115, to the end
    with open(os.devnull, "r+b") as nothing:
        os.dup2(nothing.fileno(), 0)
        os.dup2(nothing.fileno(), 1)
    main(calls, answers)
