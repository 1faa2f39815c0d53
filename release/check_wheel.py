"""Builds wheel and source distribution and uses them as others would: ``python -m release.check_wheel``.

The wheel is installed with the core dependencies alone, and with each extra alone, each time in a fresh
environment (``release/uses/`` says what is done there); tests run from the unpacked source distribution.
Needs uv and a clone. What ``[bench]`` brings is compiled from C++, for ten minutes and in 4 GB, if uv has
not got it in its cache.
"""

import argparse
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from release.contents import ROOT, build, check_source, check_wheel, unpack
from release.environments import Environment, ReleaseError, make_environment
from release.fast_tests import FAST_TESTS

USES = ROOT / "release" / "uses"
CORE = "core"
# What is not in a wheel, and uses it: put beside an environment for the extras that serve a checkout.
BESIDE = ("benchmarks", "blackbox", "tests", "pyproject.toml")
TESTS_OF_LOGS = ("tests/unit/test_import_ulog.py", "tests/unit/test_import_betaflight.py")
OPTIMAL = ("--tracks", "speedway", "--kinds", "flying", "--out", "found")
L2F = "from benchmarks.env_speed import l2f_contestant as contestant; contestant('l2f', 1024, 8).run()"


class Use(NamedTuple):
    """What an extra is for, as arguments of the interpreter.

    is_beside: it is code of the source distribution, and uses the wheel. tools: installed besides.
    """

    arguments: tuple[str, ...]
    is_beside: bool = False
    tools: tuple[str, ...] = ()


def script(name: str) -> Use:
    """Return the use that is a script in ``release/uses``, isolated from the folder that it lies in."""
    return Use(("-I", str(USES / f"{name}.py")))


USE_OF = {
    CORE: script("core"),
    "train": script("train"),
    "sweep": script("sweep"),
    "sysid": script("sysid"),
    "logs": Use(("-m", "pytest", "-q", *TESTS_OF_LOGS), True, ("pytest>=8", "hypothesis>=6")),
    "viz": script("viz"),
    "render": script("render"),
    "optimal": Use(("-m", "benchmarks.time_optimal", *OPTIMAL), True),
    "bench": Use(("-c", L2F), True),
}


def use(name: str, wheel: Path, source: Path, folder: Path) -> Environment:
    """Install a wheel with an extra, or with ``core`` dependencies alone, use it, return the environment.

    source: folder of the unpacked source distribution.

    Raises:
        ReleaseError: it cannot be installed, or does not work.
    """
    extra = "" if name == CORE else f"[{name}]"
    what = USE_OF[name]
    environment = make_environment(folder / name, [f"flytrack{extra} @ {wheel.as_uri()}", *what.tools])
    for part in BESIDE if what.is_beside else ():
        copy = shutil.copytree if (source / part).is_dir() else shutil.copy2
        copy(source / part, environment.where / part)
    environment.must_run(*what.arguments)
    return environment


def test_source(archive: Path, source: Path, folder: Path) -> str:
    """Run the fast tests from an unpacked source distribution, and collect all; return what pytest says last.

    Raises:
        ReleaseError: it cannot be installed, or a test fails.
    """
    requirement = f"flytrack[dev,train,sysid,viz] @ {archive.as_uri()}"
    environment = make_environment(folder / "source", [requirement])._replace(where=source)
    environment.must_run("-m", "pytest", "-q", "--collect-only", "-m", "slow or not slow")
    return environment.must_run("-m", "pytest", "-q", *FAST_TESTS).said.splitlines()[-1]


def check(folder: Path, names: Sequence[str], has_tests: bool) -> None:
    """Build, look into what was built, and use it; print what was found good.

    Raises:
        ReleaseError: the first thing that is not as it should be.
    """
    wheel, archive = build(folder / "dist")
    print(f"{wheel.name}: {check_wheel(wheel)} files", flush=True)
    print(f"{archive.name}: {check_source(archive)} files", flush=True)
    source = unpack(archive, folder / "unpacked")
    for name in names:
        environment = use(name, wheel, source, folder)
        print(f"{name}: works, with {len(environment.versions())} packages", flush=True)
        shutil.rmtree(environment.folder)  # they are large
    if has_tests:
        print(f"from the source distribution: {test_source(archive, source, folder)}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and check; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--only",
        nargs="*",
        choices=USE_OF,
        default=list(USE_OF),
        help="of the core and the extras (default: all)",
    )
    parser.add_argument("--no-tests", action="store_true", help="run no tests from the source distribution")
    options = parser.parse_args(arguments)
    try:
        with tempfile.TemporaryDirectory(prefix="flytrack_release_") as folder:
            check(Path(folder), options.only, not options.no_tests)
    except ReleaseError as error:
        print(f"release: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
