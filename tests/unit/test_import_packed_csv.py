"""CSV logs of others as they are packed, and rows without an end: read in bounded time and memory."""

import gzip
import struct
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from benchmarks.reliability.strangers import seeds
from flytrack_sysid import LogError, import_log
from flytrack_sysid.importing import csv_log, gunzip

CPU_S = 2.0
HEAD = b"\x1f\x8b\x08%c" + bytes(5) + b"\xff"  # of a gzip file; its flags
EMPTY = gzip.compress(b"", mtime=0)
TEXT = seeds.foreign_csv().encode()
PACKED = gzip.compress(TEXT, mtime=0)
NAMED, WITH_EXTRA = 8, 4


def _import(path: Path, content: bytes) -> np.ndarray:
    path.write_bytes(content)
    mapping = path.with_name("map.toml")
    mapping.write_text(seeds.MAPPING)
    return import_log(path, "csv", mapping).log["w"]


def _with_head(flags: int, fields: bytes) -> bytes:
    return HEAD % flags + fields + PACKED[10:]


@pytest.mark.parametrize(
    "content",
    [
        gzip.compress(TEXT[:100]) + EMPTY * 10 + gzip.compress(TEXT[100:]),
        PACKED + bytes(10_000),
        PACKED + bytes(10_000) + EMPTY,
        _with_head(NAMED, b"flight.csv\0"),
        _with_head(WITH_EXTRA, struct.pack("<H", 4) + b"abcd"),
    ],
)
def test_ways_of_packing_are_read(content: bytes, tmp_path: Path) -> None:
    expected = _import(tmp_path / "a.csv", TEXT)
    assert np.array_equal(_import(tmp_path / "b.csv.gz", content), expected)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (EMPTY * 500_000 + PACKED, "found more than 20000 members"),
        (HEAD % NAMED + b"x" * 2**26, "found no end of what is compressed"),
        (b"\0" * 2**10 + PACKED, "incorrect header check"),
        (PACKED + b"\0" * 2**26 + b"x", "found no end of what is compressed"),
        (PACKED[:-8] + bytes(8), "incorrect data check"),
        (PACKED[:-1], "found no end of what is compressed"),
        (b"", "found no end of what is compressed"),
    ],
)
def test_odd_packing_is_refused_soon(content: bytes, message: str, tmp_path: Path) -> None:
    started_s = time.process_time()
    with pytest.raises(LogError, match=rf"a\.csv\.gz: cannot be read as text: .*{message}"):
        _import(tmp_path / "a.csv.gz", content)
    assert time.process_time() - started_s < CPU_S


def test_a_large_packed_file_is_refused_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (tmp_path / "a.csv.gz").open("wb") as file:
        file.write(HEAD % NAMED)
        file.truncate(csv_log.LARGEST_BYTES + 1)
    monkeypatch.setattr(gunzip, "Gunzip", lambda _: pytest.fail("it was read"))
    (tmp_path / "map.toml").write_text(seeds.MAPPING)
    with pytest.raises(LogError, match="found more than 536870912 bytes"):
        import_log(tmp_path / "a.csv.gz", "csv", tmp_path / "map.toml")


@pytest.mark.parametrize("content", [b"," * 2**23, TEXT + b'"1\n",' * 2**21])
def test_rows_without_an_end_take_no_memory(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(content)
    (tmp_path / "map.toml").write_text(seeds.MAPPING)
    tracemalloc.start()
    try:
        with pytest.raises(LogError, match="not a CSV file: found a row of 65536 characters or more"):
            import_log(path, "csv", tmp_path / "map.toml")
        assert tracemalloc.get_traced_memory()[1] < 2**23
    finally:
        tracemalloc.stop()


def test_blank_lines_without_an_end_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv_log, "MOST_BLANK_LINES", 100)
    few = TEXT.replace(b"\n", b"\n" * 50)
    assert np.array_equal(_import(tmp_path / "a.csv", few), _import(tmp_path / "b.csv", TEXT))
    many = TEXT + b"\n" * 102
    with pytest.raises(LogError, match="more than 100 blank lines in a row"):
        _import(tmp_path / "a.csv", many)


def test_a_row_may_have_several_lines(tmp_path: Path) -> None:
    expected = _import(tmp_path / "a.csv", TEXT)
    header, *rows = TEXT.decode().splitlines()
    noted = [f'{header},"what\nwas seen"', *(f'{row},"a\n\n5"" prop"' for row in rows)]
    assert np.array_equal(_import(tmp_path / "b.csv", "\n".join(noted).encode()), expected)
