"""The wheel and the source distribution: built, and what is in them."""

import subprocess
import tarfile
import zipfile
from pathlib import Path, PurePosixPath

from release.environments import ReleaseError, find_uv, must

ROOT = Path(__file__).parents[1]
PACKAGES = ("baselines", "flytrack_env", "flytrack_loop", "flytrack_sysid")
FOR_GIT = (".gitignore", ".ci/run")  # tracked, and of no use without a clone
MADE = ("PKG-INFO", "setup.cfg")  # by setuptools; besides flytrack.egg-info
ABOUT_A_WHEEL = ("METADATA", "RECORD", "WHEEL", "entry_points.txt", "top_level.txt", "licenses/LICENSE")


def build(folder: Path) -> tuple[Path, Path]:
    """Build both into a folder, the wheel from the source, and return their paths: wheel, source.

    Raises:
        ReleaseError: no uv, or they cannot be built.
    """
    must([find_uv(), "build", "--quiet", "--out-dir", folder, ROOT], ROOT)
    (wheel,), (source,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, source


def tracked() -> set[str]:
    """Return the paths of the repository's files, those included that git would add.

    Raises:
        ReleaseError: this is no clone.
    """
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if listed.returncode != 0:
        raise ReleaseError(f"{ROOT}: found no clone of the repository, expected one: {listed.stderr}")
    return {path for path in listed.stdout.split("\0") if path and (ROOT / path).is_file()}


def compare(what: str, found: set[str], expected: set[str]) -> None:
    """Raise ReleaseError where two sets of paths differ."""
    if found != expected:
        lacks, besides = sorted(expected - found), sorted(found - expected)
        raise ReleaseError(f"{what}: lacks {lacks}, has besides {besides}")


def check_wheel(wheel: Path) -> int:
    """Check that a wheel has the packages' files, its licence and nothing else; return how many files.

    Raises:
        ReleaseError: it lacks a file, or has one too many; the message names them.
    """
    about = "-".join(wheel.name.split("-")[:2]) + ".dist-info"
    expected = {path for path in tracked() if PurePosixPath(path).parts[0] in PACKAGES}
    expected |= {f"{about}/{name}" for name in ABOUT_A_WHEEL}
    with zipfile.ZipFile(wheel) as archive:
        found = set(archive.namelist())
    compare(wheel.name, found, expected)
    return len(found)


def check_source(source: Path) -> int:
    """Check that a source distribution has every tracked file, but those for git; return how many files.

    Raises:
        ReleaseError: it lacks a file, or has one too many; the message names them.
    """
    with tarfile.open(source) as archive:
        paths = {PurePosixPath(member.name) for member in archive if member.isfile()}
    inside = {str(PurePosixPath(*path.parts[1:])) for path in paths}
    found = {path for path in inside if path not in MADE and not path.startswith("flytrack.egg-info/")}
    compare(source.name, found, tracked() - set(FOR_GIT))
    return len(found)


def unpack(source: Path, folder: Path) -> Path:
    """Unpack a source distribution and return its folder."""
    with tarfile.open(source) as archive:
        archive.extractall(folder, filter="data")
    return folder / source.name.removesuffix(".tar.gz")
