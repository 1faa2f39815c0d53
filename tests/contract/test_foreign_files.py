"""Every loader of files: a valid file is loaded; anything else is refused with the file's name, soon."""

import gzip
import os
import pickle
from pathlib import Path

import pytest

from benchmarks.reliability import foreign_logs
from benchmarks.reliability.files import KINDS, soak_kind
from flytrack_sysid import LogError, csv_file, import_log
from tests.support.slow import slow_but
from tests.support.traps import Trap

SLOW = {"imported CSV, gzip", "black box"}  # seconds for the crafted files


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_such_file_is_refused(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    contents = {
        "garbage": b"\x80\x01\xff garbage",
        "pickle": pickle.dumps(Trap()),
        "cut": KINDS[kind].content()[:40],
    }
    paths = [Path(name + KINDS[kind].suffix) for name in ("missing", "folder", "pipe", "device", *contents)]
    paths[1].mkdir()
    os.mkfifo(paths[2])
    paths[3].symlink_to("/dev/zero")
    for path, content in zip(paths[4:], contents.values(), strict=True):
        path.write_bytes(content)
    for path in paths:
        with pytest.raises(KINDS[kind].error, match=path.name):
            KINDS[kind].load(path)


@pytest.mark.parametrize("kind", slow_but(KINDS.keys() - SLOW, KINDS))
def test_damaged_and_crafted_files_are_loaded_or_refused(kind: str, tmp_path: Path) -> None:
    found = soak_kind(KINDS[kind], 60, tmp_path)
    assert found["broken"] == "" and found["loaded"] >= 1 and found["refused"] >= 1


def test_compressed_logs_are_read_and_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv_file, "PACKED_BYTES", 50_000)
    text, mapping = foreign_logs.foreign_csv(), tmp_path / "map.toml"
    mapping.write_text(foreign_logs.MAPPING)
    (tmp_path / "a.csv").write_bytes(text)
    expected = import_log(tmp_path / "a.csv", "csv", mapping).log
    path = tmp_path / "a.csv.gz"
    path.write_bytes(gzip.compress(text[:100]) + gzip.compress(text[100:]) + bytes(100))
    assert (import_log(path, "csv", mapping).log["w"] == expected["w"]).all()
    for content, message in (
        (gzip.compress(text)[:-1], "ended before"),
        (text, "Not a gzipped file"),
        (gzip.compress(text + b"\n" * 2**20), "found more than [0-9]+ characters"),
        (gzip.compress(b"," * 2**20), "found a row of 65536 characters or more"),
    ):
        path.write_bytes(content)
        with pytest.raises(LogError, match=rf"a\.csv\.gz: .*{message}"):
            import_log(path, "csv", mapping)
