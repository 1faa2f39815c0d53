"""Files that are made on purpose to do harm: of every kind there are some, and none breaks the promise."""

from pathlib import Path

import pytest

from benchmarks.reliability.strangers.kinds import KINDS
from benchmarks.reliability.strangers.pool import measure_kind

# One of each form. The others take 4 s to a minute each; the whole measurement judges them all.
FAST = ("model", "rollout", "script", "import_csv")
FEWEST = 25


def _counts(kind: str, folder: Path) -> tuple[int, int]:
    """Return how many files of a kind are well, and how many are made to harm."""
    folder.mkdir()
    KINDS[kind].write(folder)
    wells = [path.read_bytes() for path in sorted(folder.glob(f"*{KINDS[kind].suffix}"))]
    hostile = KINDS[kind].hostile(wells)
    return len(wells), len(hostile)


@pytest.mark.parametrize(
    "kind", [kind if kind in FAST else pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS]
)
def test_crafted_files_keep_the_promise(kind: str, tmp_path: Path) -> None:
    num_well, num_crafted = _counts(kind, tmp_path / "counted")
    found = measure_kind(kind, 0, num_well + num_crafted, tmp_path)
    assert (found["failure"], found["broken"], found["examples"]) == (None, {}, [])
    assert found["files"] == num_well + num_crafted and found["crafted"] == num_crafted >= FEWEST
    assert found["refused"] > num_crafted / 5
