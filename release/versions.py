"""Runs the fast tests with the newest and the oldest allowed versions: ``python -m release.versions``.

Each column of the table is a fresh environment that uv makes, with ``[train,sysid]``: of a Python with the
newest versions that the requirements allow, or with the oldest that ``pyproject.toml`` names (uv's
``lowest-direct``). The tests run from a copy of the checkout. Writes docs/results/versions.md, failures
included, and ends with 1 if there are any.
"""

import argparse
import datetime
import platform
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from flytrack_env.files import write_atomically
from release.contents import ROOT, tracked
from release.environments import ReleaseError, make_environment
from release.fast_tests import FAST_TESTS

PAGE = ROOT / "docs" / "results" / "versions.md"
NEWEST, OLDEST = "newest", "oldest"
OLDEST_PYTHON = "3.11"
PYTHONS = (OLDEST_PYTHON, "3.12", "3.13")
# Not an extra: the oldest versions claimed for the tests' own tools are no promise to users.
TEST_TOOLS = ("pytest>=9", "hypothesis>=6.150", "pyulog>=1.2", "orangebox>=0.4,<0.5")
# Old packages use what newer ones beneath them call deprecated.
OUTDATED = ("-W", "default::DeprecationWarning")
SHOWN_LINES = 40  # of what pytest said
SHOWN = (
    *("jax", "numpy", "flax", "chex", "gymnax", "gymnasium", "flatbuffers", "six"),
    *("optax", "distrax", "mlflow", "matplotlib", "scipy", "tqdm"),
)


class Row(NamedTuple):
    """What was tried: versions by name in small letters, and what pytest said last, or why it did not run."""

    python: str
    which: str
    versions: dict[str, str]
    is_good: bool
    said: str


def try_row(python: str, which: str, checkout: Path, folder: Path) -> Row:
    """Return what became of the fast tests in an environment of this Python."""
    options = ["--resolution", "lowest-direct"] if which == OLDEST else []
    requirements = [f"flytrack[train,sysid] @ {checkout.as_uri()}", *TEST_TOOLS]
    try:
        environment = make_environment(folder / f"{which}{python}", requirements, python, options)
    except ReleaseError as error:
        return Row(python, which, {}, False, str(error).splitlines()[-1])
    environment = environment._replace(where=checkout)
    lenient = OUTDATED if which == OLDEST else ()
    done = environment.run("-m", "pytest", "-q", "--durations=8", *lenient, *FAST_TESTS)
    versions = environment.versions()
    version = environment.must_run("-c", "import platform; print(platform.python_version())").said.strip()
    shutil.rmtree(environment.folder)
    print(f"{python}, {which}:\n" + "\n".join(done.said.splitlines()[-SHOWN_LINES:]), flush=True)
    return Row(version, which, versions, done.status == 0, done.said.splitlines()[-1].strip("= "))


def as_markdown(rows: Sequence[Row]) -> str:
    """Return the page: a column for each environment."""
    lines = [
        "# Versions",
        "",
        "`python -m release.versions` (or `make check-versions`): the fast tests in fresh environments with",
        "`[train,sysid]`: the newest versions that are allowed, and the oldest that `pyproject.toml` names.",
        "Warnings are errors, but for deprecations with the oldest: these use what newer packages deprecate.",
        f"{platform.machine()}, {datetime.date.today()}, no GPU.",
        "",
        "| | " + " | ".join(f"{row.which}, Python {row.python}" for row in rows) + " |",
        "|---" * (len(rows) + 1) + "|",
    ]
    lines += [
        f"| {name} | " + " | ".join(row.versions.get(name, "") for row in rows) + " |" for name in SHOWN
    ]
    lines.append("| tests | " + " | ".join(row.said for row in rows) + " |")
    lines += ["", "The fast tests are named in `release/fast_tests.py`."]
    return "\n".join(lines) + "\n"


def copy_checkout(folder: Path) -> Path:
    """Copy the repository's files, and return where they are: tests leave caches, and edits go on."""
    for path in sorted(tracked()):
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / path, target)
    return folder


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line, try every row, write the page; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pythons", nargs="*", default=list(PYTHONS), metavar="VERSION_OR_PATH")
    parser.add_argument("--no-oldest", action="store_true", help="try no oldest versions")
    parser.add_argument("--page", type=Path, default=PAGE, help="(%(default)s)")
    options = parser.parse_args(arguments)
    wanted = [(python, NEWEST) for python in options.pythons]
    wanted = wanted if options.no_oldest else [(OLDEST_PYTHON, OLDEST), *wanted]
    try:
        with tempfile.TemporaryDirectory(prefix="flytrack_versions_") as name:
            checkout = copy_checkout(Path(name) / "checkout")
            rows: list[Row] = []
            for python, which in wanted:
                rows.append(try_row(python, which, checkout, Path(name)))
                write_atomically(options.page, as_markdown(rows).encode())
    except ReleaseError as error:
        print(f"release: {error}", file=sys.stderr)
        return 1
    print(as_markdown(rows))
    return 0 if all(row.is_good for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
