"""What a function apart may do, what becomes of one that does more, and of the process beside it."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from flytrack_env.apart import Apart, ApartError, ResourceLimits, is_possible

pytestmark = pytest.mark.skipif(not is_possible(), reason="this system has no os.fork")

FUNCTION = """
import os, signal, stat, sys, time

def is_pipe(number):
    try: return stat.S_ISFIFO(os.fstat(number).st_mode)
    except OSError: return False

def do(argument, content):
    match argument:
        case "reverse": return content[::-1]
        case "say": print("words on standard output"); return b"said"
        case "pid": return str(os.getppid()).encode()
        case "raise": raise KeyError("a name")
        case "stop": sys.exit("enough")
        case "abort": os.write(2, b"LLVM ERROR: no such thing\\n"); os.abort()
        case "quit": os._exit(3)
        case "spin":
            while True: pass
        case "wait": time.sleep(60.0)
        case "eat": return bytes(2**28)[:1]
        case "gush":
            pipes = [number for number in range(3, 30) if is_pipe(number)]
            while True: os.write(pipes[0], bytes(2**16))
        case "write": open(content.decode(), "wb", buffering=0).write(b"x"); return b"written"
        case "shout": sys.stderr.write("x" * 2**20); return b"quiet"
"""
LIMITS = ResourceLimits(cpu_s=1, memory_bytes=2**27, wall_s=30.0)


@pytest.fixture(scope="module")
def apart(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Apart]:
    """Every deed above, apart."""
    file = tmp_path_factory.mktemp("apart") / "deeds.py"
    file.write_text(FUNCTION)
    found = Apart(file, "do", {})
    yield found
    found.close()


def test_result_comes_back_and_what_is_printed_does_not(apart: Apart, capfd: pytest.CaptureFixture[str]):
    assert apart("reverse", b"\x00\n12", LIMITS) == b"21\n\x00"
    assert apart("say", b"", LIMITS) == b"said"
    assert apart("reverse", bytes(2**20) + b"1", LIMITS) == b"1" + bytes(2**20)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("deed", "message"),
    [
        ("raise", "'a name'"),
        ("stop", "enough"),
        ("abort", r"crashed the process that tried it out \(SIGABRT: LLVM ERROR: no such thing\)"),
        ("quit", r"crashed .*\(exit status 3: \)"),
        ("spin", "took more than 1 s of processor time"),
        ("eat", r"needs more than 0\.125 GiB of memory"),
    ],
)
def test_what_goes_wrong_is_told_and_the_next_call_is_well(apart: Apart, deed: str, message: str):
    server = apart("pid", b"", LIMITS)
    with pytest.raises(ApartError, match=message):
        apart(deed, b"", LIMITS)
    assert apart("reverse", b"12", LIMITS) == b"21"
    assert apart("pid", b"", LIMITS) == server


def test_the_name_of_an_exception_is_told_but_not_of_a_bound(apart: Apart):
    with pytest.raises(ApartError) as caught:
        apart("raise", b"", LIMITS)
    assert caught.value.kind == "KeyError"
    with pytest.raises(ApartError) as caught:
        apart("eat", b"", LIMITS)
    assert caught.value.kind == ""  # as where it is ended from outside: one outcome, one message


def test_an_interrupted_call_leaves_no_answer_to_the_next(apart: Apart):
    interrupt = threading.Timer(0.5, signal.raise_signal, [signal.SIGINT])
    interrupt.start()
    with pytest.raises(KeyboardInterrupt):
        apart("wait", b"", LIMITS)
    started_s = time.monotonic()
    assert apart("reverse", b"12", LIMITS) == b"21"
    assert time.monotonic() - started_s < 20.0  # nobody waited for what was interrupted


CALLER = """
import sys
from pathlib import Path
from flytrack_env.apart import Apart, ResourceLimits
apart = Apart(Path(sys.argv[1]), "do", {})
limits = ResourceLimits(cpu_s=60, memory_bytes=2**27, wall_s=600.0)
print(apart("pid", b"", limits).decode(), flush=True)
apart("wait", b"", limits)
"""


def test_a_caller_that_is_gone_leaves_nothing_running(tmp_path: Path):
    file = tmp_path / "deeds.py"
    file.write_text(FUNCTION)
    caller = subprocess.Popen([sys.executable, "-c", CALLER, str(file)], stdout=subprocess.PIPE, text=True)
    assert caller.stdout is not None
    server = int(caller.stdout.readline())
    time.sleep(0.5)
    caller.kill()
    caller.communicate()
    ends_s = time.monotonic() + 20.0
    while Path(f"/proc/{server}").exists() and "State:\tZ" not in Path(f"/proc/{server}/status").read_text():
        assert time.monotonic() < ends_s, "the server outlives its caller"
        time.sleep(0.05)


def test_what_waits_or_says_too_much_is_ended(apart: Apart):
    with pytest.raises(ApartError, match=r"took more than 0\.5 s"):
        apart("wait", b"", LIMITS._replace(wall_s=0.5))
    with pytest.raises(ApartError, match="answered with too much"):
        apart("gush", b"", LIMITS._replace(memory_bytes=2**24))
    assert apart("shout", b"", LIMITS) == b"quiet"  # nobody reads it, and nobody waits for it


def test_nothing_is_written_to_a_file(apart: Apart, tmp_path: Path):
    path = tmp_path / "written"
    with pytest.raises(ApartError, match=r"SIGXFSZ|too large"):
        apart("write", str(path).encode(), LIMITS)
    assert not path.exists() or path.read_bytes() == b""


def test_a_server_that_is_gone_is_told_and_replaced(apart: Apart):
    server = int(apart("pid", b"", LIMITS))
    os.kill(server, signal.SIGKILL)
    with pytest.raises(ApartError, match="the process that tries files out is gone"):
        apart("reverse", b"12", LIMITS)
    assert int(apart("pid", b"", LIMITS)) != server


def test_a_file_that_cannot_be_imported_is_told(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    file = tmp_path / "broken.py"
    file.write_text("raise RuntimeError('of no use')")
    with pytest.raises(ApartError, match="gone"):
        Apart(file, "do", {})(None, b"", LIMITS)
    assert "of no use" in capfd.readouterr().err


def is_running(process: int) -> bool:
    """Return whether there is a process of that number that has not ended."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="asks /proc")
def test_the_server_ends_with_its_process_even_one_that_is_killed(tmp_path: Path):
    (tmp_path / "deeds.py").write_text(FUNCTION)
    code = (  # with no guard, as users write scripts
        "import os, signal\nfrom pathlib import Path\nfrom flytrack_env.apart import Apart, ResourceLimits\n"
        "apart = Apart(Path('deeds.py'), 'do', {})\n"
        "print(apart('pid', b'', ResourceLimits()).decode(), flush=True)\n"
    )
    for end in ("", "os.kill(os.getpid(), signal.SIGKILL)"):
        (tmp_path / "script.py").write_text(code + end)
        done = subprocess.run(
            [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=120
        )
        server = int(done.stdout)  # one line: the script ran once
        deadline_s = time.monotonic() + 30.0
        while is_running(server) and time.monotonic() < deadline_s:
            time.sleep(0.02)
        assert not is_running(server) and done.stderr == ""
