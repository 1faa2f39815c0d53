"""The web viewer is served to this machine only, and shows a course and a drone."""

import importlib
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from flytrack_env.references import ghost_rollout, shipped_references
from flytrack_env.tracks import load_track

pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra flytrack[viz])")
viz = importlib.import_module("flytrack_env.viz_rerun")
serving = importlib.import_module("flytrack_env.viz_rerun.serving")

TRACK = load_track("flytrack")
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> str:
    states, actions = ghost_rollout(shipped_references(TRACK, ("nominal",)), 400)
    path = tmp_path_factory.mktemp("served") / "flight.rrd"
    viz.write_recording(path, [viz.Trajectory("ghost", states, actions)], TRACK)
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


@pytest.fixture
def address(recording) -> Iterator[str]:
    server, address = serving.start_server(recording, serving.bind_port(0), open_browser=False)
    try:
        wait_until(lambda: answers(address) or server.poll() is not None, "the served page")
        assert server.poll() is None
        yield address
    finally:
        serving.stop_server(server)


@pytest.mark.slow
def test_page_is_served_to_this_machine_only(address):
    files = [file for file in Path("/proc/net").glob("tcp*") if file.name in ("tcp", "tcp6")]
    if not files:
        pytest.skip("only Linux tells in /proc/net who listens")
    port = int(address.split(":")[2].split("/")[0])
    data_port = int(address.split("%3A")[2].split("%2F")[0])
    table = "".join(file.read_text() for file in files)
    listening = [line.split()[1] for line in table.splitlines()[1:] if " 0A " in line]
    for one in (port, data_port):
        hosts = {entry.rpartition(":")[0] for entry in listening if entry.endswith(f":{one:04X}")}
        assert hosts == {"0100007F"}, hosts  # 127.0.0.1


@pytest.mark.parametrize("ending", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM])
def test_command_serves_until_it_is_ended(recording, ending):
    port = serving.bind_port(0)
    command = [sys.executable, "-m", "flytrack_env.viz_rerun", "--serve", recording]
    command += ["--port", str(port), "--no-browser"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        line = process.stdout.readline()
        assert line.startswith(f"{recording}: http://127.0.0.1:{port}/?url=")
        wait_until(lambda: answers(line.split()[1]), "the served page")
        process.send_signal(ending)
        assert process.wait(PATIENCE_S) == 0
        wait_until(lambda: not answers(f"http://127.0.0.1:{port}/"), "the end of the server")
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "cannot be read"),
        (b"\x93NUMPY", "expected a recording"),
        (b"RRF2" + bytes(range(200)), "flight.rrd: .*expected"),
    ],
)
def test_files_that_are_no_recordings_are_refused(tmp_path, content, reason):
    path = tmp_path / "flight.rrd"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(viz.ServeError, match=reason):
        serving.start_server(path, serving.bind_port(0), open_browser=False)


def test_port_that_is_taken_is_refused(recording):
    with socket.create_server((serving.HOST, 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(viz.ServeError, match=f"port {port}: .*expected one that is free"):
            viz.serve(recording, port, open_browser=False)
    with pytest.raises(viz.ServeError, match=r"port 99999: .*expected one that is free"):
        viz.serve(recording, 99999, open_browser=False)
