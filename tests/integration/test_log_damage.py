"""Flight logs of strangers: whatever a file holds, it is a sound log or a LogError in words."""

import io
import struct
import time
import tracemalloc
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy

from benchmarks.reliability.strangers import archives, soundness
from flytrack_env import npz_file
from flytrack_env.npz_file import NpzError, open_npz
from flytrack_sysid import FlightLog, LogError, load_log, log_file, log_table, save_log
from flytrack_sysid.log import CHANNELS, COLUMNS, REQUIRED

NUM_ROWS = 4
CHANNEL_NAMES = [name for name in CHANNELS if name != "u"]


def columns() -> dict[str, np.ndarray]:
    """Return the columns of a small log."""
    values = {name: np.zeros(NUM_ROWS) for name in (*REQUIRED, "v_bat")}
    return values | {"t": 0.01 * np.arange(NUM_ROWS)}


def load(path: Path, content: bytes) -> FlightLog | None:
    """Return the log of a file's bytes, checked; None where it is refused as it should be."""
    path.write_bytes(content)
    try:
        log = load_log(path)
    except LogError as error:
        said = str(error)
        assert said.startswith(str(path)) and len(said) < 2000 and said.isprintable()
        return None
    soundness.log(log)
    return log


def text_of(values: dict[str, np.ndarray]) -> str:
    """Return columns as CSV."""
    rows = zip(*(column.tolist() for column in values.values()), strict=True)
    return "\n".join([",".join(values), *(",".join(map(repr, row)) for row in rows)]) + "\n"


def assert_same(found: FlightLog, log: FlightLog) -> None:
    """Assert that a log came back: the same numbers, quaternions but for rounding."""
    np.testing.assert_array_equal(found.time, log.time)
    np.testing.assert_array_equal(np.cumsum(found.is_start()), np.cumsum(log.is_start()))
    assert set(found.channels) == set(log.channels)
    for name, values in log.channels.items():
        np.testing.assert_allclose(found[name], values, atol=1e-15 if name == "q" else 0.0, rtol=0.0)


NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def logs(draw: st.DrawFn) -> FlightLog:
    """Draw a log of any finite numbers, in some segments, whose times grow."""
    num_rows = draw(st.integers(1, 8))
    names = draw(st.sets(st.sampled_from(CHANNEL_NAMES)))
    start = draw(st.floats(-1e9, 1e9))
    steps = draw(st.lists(st.floats(1e-6, 1e6), min_size=num_rows, max_size=num_rows))
    ends = draw(st.lists(st.booleans(), min_size=num_rows, max_size=num_rows))
    sizes = {name: len(CHANNELS[name]) for name in names}
    channels = {
        name: draw(st_numpy.arrays(float, (num_rows, size), elements=NUMBERS)) for name, size in sizes.items()
    }
    if "q" in channels:
        channels["q"] = np.tile([0.6, 0.0, 0.8, 0.0], (num_rows, 1))
    channels["u"] = draw(st_numpy.arrays(float, (num_rows, 4), elements=st.floats(-1.0, 1.0)))
    # What a step of 1 us is lost in, at 1e9 s, is no log.
    time_s = start + np.cumsum(steps)
    segment = 3 + np.cumsum(np.array(ends) | np.append(False, np.diff(time_s) <= 0.0))
    return FlightLog(time_s, channels, segment)


@settings(max_examples=150, deadline=None)
@given(log=logs(), suffix=st.sampled_from([".npz", ".csv"]))
def test_any_log_is_read_back_as_it_was_written(
    log: FlightLog, suffix: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / f"any{suffix}"
    save_log(path, log)
    assert_same(load_log(path), log)


CELLS = st.text(st.characters(exclude_categories=["Cs"]), max_size=12) | st.floats().map(repr)


@settings(max_examples=300, deadline=None)
@given(row=st.integers(0, NUM_ROWS), column=st.integers(0, 5), cell=CELLS)
@example(row=1, column=1, cell="1e999")
@example(row=0, column=0, cell="x" * 130_000)
@example(row=0, column=0, cell="\x1b[31m")
def test_any_cell_is_a_log_or_a_refusal(
    row: int, column: int, cell: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    rows = [line.split(",") for line in text_of(columns()).splitlines()]
    rows[row][column] = cell
    content = "\n".join(",".join(cells) for cells in rows).encode()
    load(tmp_path_factory.getbasetemp() / "cell.csv", content)


@settings(max_examples=300, deadline=None)
@given(start=st.integers(0, 400), end=st.integers(0, 3000), put=st.binary(max_size=40), is_text=st.booleans())
def test_random_damage_is_a_refusal_or_a_log(
    start: int, end: int, put: bytes, is_text: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    content = text_of(columns()).encode()
    if not is_text:
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **columns())
        content = buffer.getvalue()
    suffix = ".csv" if is_text else ".npz"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy's, of headers that Python 2 seems to have written
        path = tmp_path_factory.getbasetemp() / f"damaged{suffix}"
        load(path, content[:start] + put + content[max(start, end) :])


ARRAYS = st_numpy.arrays(
    st.one_of(st_numpy.scalar_dtypes(), st_numpy.byte_string_dtypes(), st_numpy.unicode_string_dtypes()),
    st_numpy.array_shapes(min_dims=0, max_dims=3, max_side=5) | st.just((NUM_ROWS,)),
)


@settings(max_examples=300, deadline=None)
@given(column=st.sampled_from(COLUMNS), array=ARRAYS)
def test_any_array_in_any_column_is_a_log_or_a_refusal(
    column: str, array: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, **{**columns(), column: array})
    load(tmp_path_factory.getbasetemp() / "array.npz", buffer.getvalue())


def test_bytes_that_become_too_many_numbers_are_refused_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_table, "LARGEST_VALUES", 6 * 1000)
    path = tmp_path / "bytes.npz"
    np.savez_compressed(path, **{name: np.zeros(1001, np.int8) for name in columns()})
    monkeypatch.setattr(log_file, "_read_array", lambda *_: pytest.fail("the array was read"))
    with pytest.raises(LogError, match=r"bytes\.npz: found more than 6000 numbers"):
        load_log(path)


def test_rows_are_counted_while_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_table, "LARGEST_VALUES", 6 * 1000)
    monkeypatch.setattr(log_table, "BLOCK_VALUES", 60)
    path = tmp_path / "rows.csv"
    many = {name: np.zeros(999) for name in columns()} | {"t": np.arange(999.0)}
    path.write_text(text_of(many))
    log = load_log(path)  # in seventeen blocks
    np.testing.assert_array_equal(log.time, np.arange(999.0))
    path.write_text(text_of({name: np.zeros(1010) for name in columns()}))
    with pytest.raises(LogError, match=r"rows\.csv: found more than 6000 numbers"):
        load_log(path)


def test_a_log_of_zeros_in_half_a_megabyte_takes_little_time_and_memory(tmp_path: Path) -> None:
    path, num_rows = tmp_path / "zeros.npz", 2**21
    np.savez_compressed(path, **{name: np.zeros(num_rows, np.int8) for name in COLUMNS})
    assert path.stat().st_size < 10**6
    started_s = time.process_time()
    tracemalloc.start()
    try:
        with pytest.raises(LogError, match="found more than"):
            load_log(path)
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()
    assert time.process_time() - started_s < 1.0


# Archives of arrays, of any reader


def names_in(path: Path, content: bytes) -> list[str]:
    """Return the names of the arrays of an archive's bytes."""
    path.write_bytes(content)
    with open_npz(path) as archive:
        return archive.names


def test_an_archive_of_very_many_files_is_refused_before_their_list_is_read(tmp_path: Path) -> None:
    few = archives.zipped([("t.npy", b"")] * 3)
    assert names_in(tmp_path / "few.npz", few) == ["t"] * 3
    many = archives.zipped([(f"{number}.npy", b"") for number in range(5000)])
    # As it says itself, in a comment behind another end, and as archives of more than 65,535 files have it.
    behind = few[:-22] + many[-22:-2] + struct.pack("<H", 22) + few[-22:]
    large = few[:-22] + b"PK\x06\x07" + bytes(16) + few[-22:]
    for content in (many, behind, large):
        with pytest.raises(NpzError, match="found a list of more than 65536 bytes"):
            names_in(tmp_path / "many.npz", content)


@pytest.mark.parametrize("version", [b"\x01\x00", b"\x02\x00", b"\x03\x00", b"\x09\x09"])
def test_a_header_that_announces_gigabytes_is_not_made_room_for(version: bytes, tmp_path: Path) -> None:
    path = tmp_path / "flight.npz"
    array = b"\x93NUMPY" + version + b"\xff\xff\xff\x7f" + b"{" * 100
    np.savez(path, **columns())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("v_bat2.npy", array)
    tracemalloc.start()
    try:
        with open_npz(path) as found, pytest.raises(NpzError):
            found.read("v_bat2")
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("descr", "shape", "reason"),
    [
        ("'<f8'", "(-1,)", r"shape \(-1,\), expected one of values that take room"),
        ("'<f8'", "(True,)", r"shape \(True,\), expected"),
        ("'<U0'", "(10**12,)", "damaged, cannot be read: ValueError"),
        ("'<U0'", "(1000000000000,)", "found an array of <U0, shape"),
        ("'|O'", "(1,)", "found an array of object, expected plain values: pickles are never read"),
        ("[('a', '|O')]", "(1,)", "expected plain values: pickles are never read"),
        ("'<f8'", "(2, 3)", "found 8 bytes, expected 6 numbers of 8 bytes"),
        ("'<f8'", "'a'", "damaged, cannot be read: ValueError"),
        ("__import__('os').abort()", "(1,)", "damaged, cannot be read: ValueError"),
    ],
)
def test_headers_that_lie_are_refused(descr: str, shape: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "lie.npz"
    path.write_bytes(archives.zipped([("t.npy", archives.npy(np.zeros(1), descr=descr, shape=shape))]))
    with open_npz(path) as archive, pytest.raises(NpzError, match=reason):
        archive.read("t")


def test_arrays_of_fortran_order_come_back(tmp_path: Path) -> None:
    array = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    np.savez(tmp_path / "a.npz", array=array)
    with open_npz(tmp_path / "a.npz") as archive:
        np.testing.assert_array_equal(archive.read("array"), array)
        assert archive.header("array").num_values == 6
    assert npz_file.LARGEST_HEADER_BYTES < 2**20
