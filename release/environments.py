"""Fresh Python environments, made by uv, and commands in them that see nothing of a checkout."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

HOW_TO_GET_UV = "uv is needed, and was not found: pip install uv, or https://docs.astral.sh/uv/"
LAST_LINES = 40  # of what a command said that went wrong
# Where modules, caches and settings would come from that belong to whoever runs the check.
OF_THE_CALLER = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "JAX_COMPILATION_CACHE_DIR")


class ReleaseError(Exception):
    """Something that is to be released is not as it should be; the message is for people."""


class Done(NamedTuple):
    """A command that ran."""

    status: int
    said: str
    seconds: float


class Environment(NamedTuple):
    """An environment and where commands in it are run."""

    folder: Path
    where: Path

    @property
    def python(self) -> Path:
        """Return its interpreter."""
        return self.folder / "bin" / "python"

    def run(self, *arguments: str | Path) -> Done:
        """Run its interpreter with arguments."""
        return run([self.python, *arguments], self.where)

    def must_run(self, *arguments: str | Path) -> Done:
        """Run its interpreter with arguments.

        Raises:
            ReleaseError: it ends with another status than 0; the message ends with what it said last.
        """
        return must([self.python, *arguments], self.where)

    def versions(self) -> dict[str, str]:
        """Return the versions of what is installed, by name in small letters."""
        listed = must([find_uv(), "pip", "list", "--format", "freeze", "--python", self.python], self.where)
        lines = (line.partition("==") for line in listed.said.splitlines())
        return {name.lower(): version for name, equals, version in lines if equals}


def find_uv() -> str:
    """Return the path of uv: of this interpreter's environment, or on the search path.

    Raises:
        ReleaseError: there is none; the message says how to get it.
    """
    found = shutil.which("uv", path=str(Path(sys.executable).parent)) or shutil.which("uv")
    if found is None:
        raise ReleaseError(HOW_TO_GET_UV)
    return found


def run(command: Sequence[str | Path], where: Path) -> Done:
    """Run a command in a folder, with nothing of the caller's that Python would look at."""
    environ = {name: value for name, value in os.environ.items() if name not in OF_THE_CALLER}
    environ |= {"JAX_PLATFORMS": "cpu", "MPLBACKEND": "agg", "SDL_VIDEODRIVER": "dummy"}
    began = time.monotonic()
    ran = subprocess.run(
        [str(part) for part in command], cwd=where, env=environ, capture_output=True, text=True
    )
    return Done(ran.returncode, ran.stdout + ran.stderr, time.monotonic() - began)


def must(command: Sequence[str | Path], where: Path) -> Done:
    """Run a command in a folder.

    Raises:
        ReleaseError: it ends with another status than 0; the message ends with what it said last.
    """
    done = run(command, where)
    if done.status != 0:
        last = "\n".join(done.said.splitlines()[-LAST_LINES:])
        raise ReleaseError(f"{' '.join(map(str, command))}: ended with status {done.status}:\n{last}")
    return done


def make_environment(
    folder: Path, requirements: Sequence[str], python: str = sys.executable, options: Sequence[str] = ()
) -> Environment:
    """Return a new environment in a new folder, with these requirements and what they need.

    python: a version or a path. options: of ``uv pip install``. Commands are run in an empty folder in it.

    Raises:
        ReleaseError: no uv, no such interpreter, or requirements that cannot be installed.
    """
    uv = find_uv()
    folder.parent.mkdir(parents=True, exist_ok=True)
    must((uv, "venv", "--quiet", "--python", python, folder), folder.parent)
    environment = Environment(folder, folder / "empty")
    environment.where.mkdir()
    there = ("--quiet", "--python", str(environment.python))
    must((uv, "pip", "install", *there, *options, *requirements), environment.where)
    must((uv, "pip", "check", *there), environment.where)
    return environment
