"""Rerun's own web viewer on a recording, served to this machine only."""

import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from rerun.chunk import RrdReader

HOST = "127.0.0.1"
ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class ServeError(ValueError):
    """A recording that cannot be served; the message names the file or the port."""


def check_recording(path: str | Path) -> None:
    """Raise ServeError for a file that is no recording."""
    try:
        with Path(path).open("rb"):  # for the operating system's own message
            recordings = RrdReader(path).recordings()
    except Exception as error:  # OSError, or whatever the reader raises
        raise ServeError(f"{path}: cannot be read: {error}; expected a recording (.rrd)") from error
    if not recordings:
        raise ServeError(f"{path}: found no flights, expected a recording (.rrd)")


def bind_port(port: int) -> int:
    """Return a port that can be bound, any free one for 0; raises ServeError for one that cannot."""
    with socket.socket() as probe:
        try:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((HOST, port))
        except (OSError, OverflowError) as error:
            raise ServeError(f"port {port}: {error}; expected one that is free") from error
        return probe.getsockname()[1]


def _interrupt(*_: Any) -> NoReturn:
    raise KeyboardInterrupt


def serve(path: str | Path, port: int, open_browser: bool) -> None:
    """Serve the web viewer on a recording until the program is interrupted or terminated; main thread only.

    Raises:
        ServeError: no recording, a port that is taken, or a server that ends by itself.
    """
    check_recording(path)
    port, data_port = bind_port(port), bind_port(0)
    # Unlike the SDK's own functions, the command can be restricted to this machine.
    command = [sys.executable, "-m", "rerun", str(path), "--bind", HOST, "--port", str(data_port)]
    command += ["--web-viewer-port", str(port), "--web-viewer" if open_browser else "--serve-web"]
    before = {one: signal.signal(one, _interrupt) for one in ENDING}
    # A session of its own, to be ended as a whole: the command is a wrapper around a program.
    quiet = subprocess.DEVNULL
    server = subprocess.Popen(command, start_new_session=True, stdout=quiet, stderr=quiet)
    try:
        query = f"url=rerun%2Bhttp%3A%2F%2F{HOST}%3A{data_port}%2Fproxy"
        print(f"{path}: http://{HOST}:{port}/?{query} (Ctrl-C ends it)", flush=True)
        status = server.wait()
    except KeyboardInterrupt:
        return
    finally:
        with suppress(ProcessLookupError):
            os.killpg(server.pid, signal.SIGTERM)
        server.wait()
        for one, handler in before.items():
            signal.signal(one, handler)
    raise ServeError(f"{path}: the viewer's server ended with status {status}, expected it to go on")
