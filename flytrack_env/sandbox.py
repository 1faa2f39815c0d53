"""Running a function on untrusted bytes in a process of its own, with limits on time and memory.

Each call starts a Python interpreter, which runs this file as a script and imports one other file.
It imports neither the caller's ``__main__``, so a script needs no guard, nor this package, which
would take seconds. macOS does not limit the memory; Windows limits the time only, by the clock.
"""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

# characters of an exception's message, which a foreign file may have written
MAX_MESSAGE_LENGTH = 1000
RETURNED, RAISED = b"R", b"E"  # first byte of the output
MEMORY_STATUS = Path("/proc/self/status")


class ResourceLimits(NamedTuple):
    """What a call may use.

    Attributes:
        cpu_s: whole seconds of processor time.
        memory_bytes: beyond what the process has once it has imported the function.
        wall_s: s on the clock, imports included.
    """

    cpu_s: int = 4
    memory_bytes: int = 2**30
    wall_s: float = 60.0


class SandboxError(Exception):
    """A call that did not return.

    Args:
        kind: name of the exception if the function raised one.
    """

    def __init__(self, text: str, kind: str = ""):
        super().__init__(text)
        self.kind = kind


def run(
    file: Path,
    function: str,
    argument: Any,
    content: bytes = b"",
    limits: ResourceLimits = ResourceLimits(),  # noqa: B008, a tuple of constants
    environment: Mapping[str, str] | None = None,
) -> bytes:
    """Return ``function(argument, content)`` of a file that does not import this package.

    The function can write no files; what it prints is discarded.

    Args:
        argument: JSON values.
        environment: added to that of this process.

    Raises:
        SandboxError: the function raised, exceeded a limit, or crashed; the message says which.
    """
    call = {"file": str(file), "function": function, "argument": argument, "limits": limits}
    try:
        done = subprocess.run(
            [sys.executable, "-P", __file__],
            input=json.dumps(call).encode() + b"\n" + content,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **(environment or {})},
            timeout=limits.wall_s,
        )
    except subprocess.TimeoutExpired as error:
        raise SandboxError(f"took more than {limits.wall_s:g} s") from error
    except OSError as error:
        raise SandboxError(f"cannot start a process to try it in: {error}") from error
    kind, text = done.stdout[:1], done.stdout[1:]
    if kind == RETURNED and done.returncode == 0:
        return text
    if kind == RAISED:
        name, message = json.loads(text)
        if name != MemoryError.__name__:
            raise SandboxError(message, name)
        raise SandboxError(f"needs more than {limits.memory_bytes / 2**30:g} GiB of memory")
    if done.returncode == -getattr(signal, "SIGXCPU", 0):
        raise SandboxError(f"took more than {limits.cpu_s} s of processor time")
    how = (
        f"status {done.returncode}"
        if done.returncode >= 0
        else signal.Signals(-done.returncode).name
    )
    raise SandboxError(f"crashed the process that it was tried in ({how})")


def limit_memory(memory_bytes: int) -> None:
    """Let this process allocate at most that much more than it has; on Linux only."""
    if MEMORY_STATUS.exists():
        status = dict(line.split(":", 1) for line in MEMORY_STATUS.read_text().splitlines())
        _limit("RLIMIT_DATA", int(status["VmData"].split()[0]) * 1024 + memory_bytes)


def _limit(name: str, value: int) -> None:
    if sys.platform != "win32":
        import resource  # not on Windows

        kind = getattr(resource, name)
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(
            kind, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard)
        )


def main() -> None:
    """Run the call on standard input; write its result, or what it raised, to standard output."""
    call = json.loads(sys.stdin.buffer.readline())
    content = sys.stdin.buffer.read()
    with open(os.dup(1), "wb") as output:
        os.dup2(2, 1)  # what the function prints must not mix with its result
        try:
            spec = importlib.util.spec_from_file_location(Path(call["file"]).stem, call["file"])
            assert spec is not None and spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            limits = ResourceLimits(*call["limits"])
            limit_memory(limits.memory_bytes)
            _limit("RLIMIT_CPU", limits.cpu_s + int(time.process_time()))
            _limit("RLIMIT_FSIZE", 0)
            _limit("RLIMIT_CORE", 0)
            output.write(RETURNED + getattr(module, call["function"])(call["argument"], content))
        except BaseException as error:  # reported to the caller, whatever it is
            output.write(
                RAISED
                + json.dumps([type(error).__name__, str(error)[:MAX_MESSAGE_LENGTH]]).encode()
            )


if __name__ == "__main__":
    main()
