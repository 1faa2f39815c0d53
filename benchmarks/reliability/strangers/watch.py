"""What a load may do in a process, watched: time, memory, and what no reading of data does."""

import os
import resource
import sys
import sysconfig
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from flytrack_env.apart_server import data_bytes

CPU_S, MEMORY_BYTES = 5.0, 2**30
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
FORBIDDEN = (
    *("pickle.find_class", "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.forkpty"),
    *(
        "subprocess.Popen",
        "pty.spawn",
        "ctypes.dlopen",
        "code.__new__",
        "os.putenv",
        "os.kill",
        "webbrowser.open",
    ),
    *("os.remove", "os.rename", "os.rmdir", "os.mkdir", "os.link", "os.symlink", "os.chmod", "os.truncate"),
)
FORBIDDEN_FAMILIES = ("socket.", "ftplib.", "http.client.", "urllib.", "smtplib.", "shutil.", "winreg.")
ROOT = Path(__file__).parents[3]
CODE = tuple({sys.prefix, sys.base_prefix, sysconfig.get_paths()["stdlib"], str(ROOT), "<frozen"})


class Watch:
    """Notes what loads do that they may not, from when it is made; Python forgets no hook.

    folder: where they may write.
    """

    def __init__(self, folder: Path):
        self._folder = os.path.realpath(folder)
        self.seen: list[str] = []
        self.is_on = False
        sys.addaudithook(self._note)

    def _note(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.is_on and (what := self._forbidden(event, arguments)):
            self.seen.append(what)

    def _forbidden(self, event: str, arguments: tuple[Any, ...]) -> str | None:
        if event in FORBIDDEN or event.startswith(FORBIDDEN_FAMILIES):
            return f"{event} {arguments!r}"[:200]
        if event == "open":
            path, _, flags = arguments
            is_ours = isinstance(path, int) or os.path.realpath(path).startswith((self._folder, os.devnull))
            return None if is_ours or not flags & WRITING else f"open {path!r} to write"[:200]
        if event == "exec":
            # Modules that are imported late run their code, which is in files of the installation.
            name = getattr(arguments[0], "co_filename", "")
            return None if name.startswith(CODE) else f"exec of {name!r}"[:200]
        if event == "compile" and not _is_parsing():
            return f"compile {str(arguments[0])[:100]!r}"
        return None


def _is_parsing() -> bool:
    """Return whether the caller's text is only parsed, as NumPy does with headers: none of it is run."""
    frame = sys._getframe(3)
    while frame is not None:
        if frame.f_code.co_name in ("literal_eval", "_find_and_load"):
            return True
        frame = frame.f_back  # type: ignore[assignment]
    return False


@contextmanager
def bounded(has_children: bool) -> Iterator[None]:
    """Bound the memory that is taken from here on, and the processor time, which ends the process.

    has_children: others work for it, and would inherit the bound on time.
    """
    before, hard = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, ((data_bytes() or 0) + MEMORY_BYTES, hard))
    if not has_children:
        cpu_hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
        resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time() + CPU_S) + 2, cpu_hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (before, hard))


def children() -> list[int]:
    """Return the processes that this one has started and that run."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        if int(fields[1]) == os.getpid():
            found.append(int(path.parent.name))
    return found


def cpu_of(processes: list[int]) -> float:
    """Return the processor time of this process, and of others with what ran under them, s."""
    total = time.process_time()
    for process in processes:
        try:
            fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        total += sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
    return total
