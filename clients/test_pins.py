"""The clients run at the versions that the files name, on the same JAX as everything else."""

import re
from importlib.metadata import version
from pathlib import Path

import pytest
from packaging.requirements import Requirement

HERE = Path(__file__).parent


def pins_of(path: Path) -> dict[str, str]:
    """Return the version of every package that a requirements file pins for this Python."""
    lines = re.findall(r"^[a-z0-9][^#\\\n]*", path.read_text(encoding="utf-8"), re.MULTILINE)
    requirements = [Requirement(line) for line in lines]
    wanted = [one for one in requirements if one.marker is None or one.marker.evaluate()]
    return {one.name: str(one.specifier).removeprefix("==") for one in wanted}


@pytest.mark.parametrize("name", pins_of(HERE / "requirements.txt"))
def test_clients_are_those_of_the_requirements(name: str) -> None:
    # A build of torch for the CPU calls itself 2.13.0+cpu.
    assert version(name).partition("+")[0] == pins_of(HERE / "requirements.txt")[name]


@pytest.mark.parametrize("name", ["jax", "jaxlib", "flax", "gymnax", "gymnasium", "numpy"])
def test_clients_leave_the_lock_file_alone(name: str) -> None:
    assert version(name) == pins_of(HERE.parent / "requirements.lock")[name]


def test_the_four_clients_are_pinned() -> None:
    assert {"rejax", "evosax", "stable-baselines3", "torch"} <= pins_of(HERE / "requirements.txt").keys()
