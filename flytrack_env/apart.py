"""Running a function on a stranger's bytes in a process of its own, with bounds on time and memory.

A server (``apart_server.py``) imports the function's file once and forks a child for every call, so that a
call costs a few milliseconds more than the function. It starts no second interpreter of the caller's
program: a script needs no ``__main__`` guard. It needs ``os.fork``, which Windows does not have; macOS
does not bound the memory.
"""

import atexit
import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

SERVER = Path(__file__).with_name("apart_server.py")


class ResourceLimits(NamedTuple):
    """What a call may use.

    cpu_s: whole seconds of processor time. memory_bytes: beyond what an idle process has. wall_s: s on the
    clock, for what waits and uses no processor.
    """

    cpu_s: int = 4
    memory_bytes: int = 2**30
    wall_s: float = 60.0


class ApartError(Exception):
    """A call that returned nothing; ``kind`` is the exception's name where the function raised one."""

    def __init__(self, text: str, kind: str = ""):
        super().__init__(text)
        self.kind = kind


def is_possible() -> bool:
    """Return whether this system has what it takes."""
    return hasattr(os, "fork") and bool(sys.executable)


class Apart:
    """A function ``(argument, content) -> bytes`` in a file, run apart; argument: JSON values.

    The file is read on its own, without the package around it, so that it imports no more than it needs. A
    function ``prepare`` in it is called once, before any call.
    environment: added to that of the server.
    """

    def __init__(self, file: Path, function: str, environment: Mapping[str, str]):
        self._setup = {"file": str(file), "function": function}
        self._environment = dict(environment)
        # By process: one that was forked off shares no server with the one before it, and must not end it.
        self._servers: dict[int, subprocess.Popen[bytes]] = {}
        self._lock = threading.Lock()
        atexit.register(self.close)

    def __call__(self, argument: Any, content: bytes, limits: ResourceLimits) -> bytes:
        """Return what the function returns.

        Raises:
            ApartError: what became of the call instead, in words.
        """
        call = {"argument": argument, "size": len(content), **limits._asdict()}
        with self._lock:
            try:
                answer, result = self._ask(call, content)
            except (OSError, ValueError) as error:
                self._forget()
                raise ApartError(f"the process that tries files out is gone: {error}") from error
            except BaseException:  # Ctrl+C: its answer, still to come, is none to the next call
                self._kill()
                raise
        if answer["ended"] != "returned":
            raise ApartError(_in_words(answer, limits), answer.get("type", ""))
        return result

    def close(self) -> None:
        """End the server, if this process started one."""
        with self._lock:
            self._forget()

    def _ask(self, call: dict[str, Any], content: bytes) -> tuple[dict[str, Any], bytes]:
        server = self._running()
        assert server.stdin is not None and server.stdout is not None
        server.stdin.write(json.dumps(call).encode() + b"\n" + content)
        server.stdin.flush()
        answer = json.loads(server.stdout.readline())
        return answer, server.stdout.read(answer["size"])

    def _running(self) -> subprocess.Popen[bytes]:
        """Return the server of this process, started if there is none."""
        server = self._servers.get(os.getpid())
        if server is None:
            server = self._servers[os.getpid()] = subprocess.Popen(
                [sys.executable, "-P", str(SERVER)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env={**os.environ, **self._environment},
                start_new_session=True,  # Ctrl+C is for the program, which then ends it
            )
            assert server.stdin is not None and server.stdout is not None
            setup = {**self._setup, "path": [os.path.abspath(entry) for entry in sys.path]}
            server.stdin.write(json.dumps(setup).encode() + b"\n")
            server.stdin.flush()
            json.loads(server.stdout.readline())  # nothing, which is no JSON, where it could not begin
        return server

    def _kill(self) -> None:
        """End the server and what it runs at once."""
        server = self._servers.get(os.getpid())
        if server is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(server.pid, signal.SIGKILL)  # the server leads a session of its own
        self._forget()

    def _forget(self) -> None:
        """End the server, so that the next call starts another."""
        server = self._servers.pop(os.getpid(), None)
        if server is None:
            return
        assert server.stdin is not None and server.stdout is not None
        with contextlib.suppress(OSError):  # what was not sent yet, to a server that is gone
            server.stdin.close()
        server.stdout.close()
        server.wait()


def _in_words(answer: dict[str, Any], limits: ResourceLimits) -> str:
    """Return what became of a call."""
    return {
        "raised": answer["text"],
        "crashed": f"it crashed the process that tried it out ({answer['text']})",
        "killed": "the process that tried it out was killed",
        "cpu": f"it took more than {limits.cpu_s} s of processor time",
        "late": f"it took more than {limits.wall_s:g} s, or answered with too much",
        "memory": f"it needs more than {limits.memory_bytes / 2**30:g} GiB of memory",
    }[answer["ended"]]
