"""Logs whose last tenth is missing, as when the battery was pulled."""

import re
from pathlib import Path

import numpy as np
import pytest

from flytrack_sysid import LogError, import_log
from tests.support.foreign_logs import CLOCK_WRITERS

STEP_S, NUM_ROWS, KEPT = 0.004, 1000, 0.9
# What a note says where the whole rows are used, or why the log is refused; least rows that are
# used.
USED = {
    "ULog": (
        700,
        "cut off: used up to the last whole message",
    ),  # topic by topic, so that some end earlier
    "blackbox": (890, "cut off: found no end-of-log event; 8.. whole frames used"),
    "DataFlash": (890, "cut off: used up to the last whole message"),
    "uSD": (890, "damaged or cut off: .* bytes are used"),
}
PART_OF_A_ROW = r"row \d+ \(line \d+\): found 1 cells, expected \d as in the header"
REFUSED = {"bag": "damaged, cannot be decoded", "CSV": PART_OF_A_ROW, "CSV files": PART_OF_A_ROW}


def cut_off(kind: str, folder: Path) -> tuple[Path, str, Path | None]:
    """Return a log without its last tenth, its format and its mapping."""
    form, write = CLOCK_WRITERS[kind]
    path, mapping = write(folder, 100.0 + STEP_S * np.arange(NUM_ROWS))
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    largest = max(files, key=lambda file: file.stat().st_size)
    content = largest.read_bytes()
    end = int(KEPT * len(content)) - 11  # within a message of every format
    if form == "csv":
        end = content.rindex(b"\n", 0, end) + 4  # within the first cell of a row
    largest.write_bytes(content[:end])
    return path, form, mapping


@pytest.mark.parametrize("kind", USED)
def test_the_whole_rows_of_a_cut_off_log_are_used(kind: str, tmp_path: Path) -> None:
    least, note = USED[kind]
    path, form, mapping = cut_off(kind, tmp_path)
    found = import_log(path, form, mapping, align=False)
    assert least <= len(found.log) < NUM_ROWS
    assert re.search(note, " ".join(found.notes))


@pytest.mark.parametrize("kind", REFUSED)
def test_a_cut_off_log_that_cannot_be_used_is_refused(kind: str, tmp_path: Path) -> None:
    path, form, mapping = cut_off(kind, tmp_path)
    with pytest.raises(LogError, match=REFUSED[kind]):
        import_log(path, form, mapping, align=False)


def test_every_format_is_in_one_of_the_tables() -> None:
    assert {*USED, *REFUSED} == set(CLOCK_WRITERS)
