"""The web viewer is served to this machine only, until the command ends."""

import importlib
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.recordings import make_sequence

pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra flytrack[viz])")
viz = importlib.import_module("flytrack_env.viz_rerun")
serving = importlib.import_module("flytrack_env.viz_rerun.serving")

PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("served") / "flight.rrd"
    trajectory = viz.Trajectory("flight", *zip(*make_sequence(20), strict=True))
    viz.write_recording(path, [trajectory], None)
    return str(path)


def wait_until(is_done: Callable[[], bool], what: str) -> None:
    ends = time.monotonic() + PATIENCE_S
    while not is_done():
        assert time.monotonic() < ends, f"{what}: not within {PATIENCE_S:g} s"
        time.sleep(0.2)


def answers(address: str) -> bool:
    try:
        with urllib.request.urlopen(address, timeout=5) as page:
            return b"rerun" in page.read().lower()
    except OSError:
        return False


def hosts_listening_on(port: int) -> set[str]:
    """Return the hosts, hexadecimal, that listen on a port (Linux)."""
    table = "".join(Path("/proc/net", name).read_text() for name in ("tcp", "tcp6"))
    listening = [line.split()[1].split(":") for line in table.splitlines() if " 0A " in line]
    return {host for host, found in listening if found == f"{port:04X}"}


@pytest.mark.slow
def test_command_serves_to_this_machine_only_until_it_is_terminated(recording):
    port = serving.bind_port(0)
    command = [sys.executable, "-m", "flytrack_env.viz_rerun", "--serve", recording]
    command += ["--port", str(port), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            line = process.stdout.readline()
            assert line.startswith(f"{recording}: http://127.0.0.1:{port}/?url=")
            wait_until(lambda: answers(line.split()[1]), "the served page")
            if sys.platform == "linux":
                data_port = int(line.split("%3A")[2].split("%2F")[0])
                assert hosts_listening_on(port) | hosts_listening_on(data_port) == {"0100007F"}
            process.send_signal(signal.SIGTERM)
            assert process.wait(PATIENCE_S) == 0
            wait_until(lambda: not answers(f"http://127.0.0.1:{port}/"), "the end of the server")
        finally:
            process.kill()


@pytest.mark.parametrize("content", [b"\x93NUMPY", b"RRF2" + bytes(range(200))])
def test_files_that_are_no_recordings_and_taken_ports_are_refused(tmp_path, recording, content):
    path = tmp_path / "flight.rrd"
    path.write_bytes(content)
    with pytest.raises(viz.ServeError, match=r"flight.rrd: .*expected a recording"):
        viz.serve(path, 0, open_browser=False)
    with socket.create_server((serving.HOST, 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(viz.ServeError, match=f"port {port}: .*expected one that is free"):
            viz.serve(recording, port, open_browser=False)
