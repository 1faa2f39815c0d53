"""Flight log files: every refusal names file and reason, quickly and in little memory."""

import io
import re
import tracemalloc
import zipfile
from collections.abc import Callable

import numpy as np
import pytest

from flytrack_sysid.log import REQUIRED, LogError
from flytrack_sysid.log_file import load_log
from tests.support.traps import Trap
from tests.support.written_logs import NUM_ROWS, SUFFIXES, columns_of, make_log, write


def set_cell(column: str, row: int, value: float) -> Callable[[dict], None]:
    return lambda columns: columns[column].__setitem__(row, value)


def rename(old: str, new: str) -> Callable[[dict], None]:
    return lambda columns: columns.update({new: columns.pop(old)})


def segments(*values: float) -> Callable[[dict], None]:
    return lambda columns: columns.update(segment=np.array(values))


# What the message says after the file, {row} with the line in a CSV file; and what is done to the columns.
BAD_COLUMNS = {
    r"column 'w_roll': unknown; .*\(known: t, segment, u_roll, ": rename("w_x", "w_roll"),
    "column t: missing; found ": rename("t", "segment"),
    "column u_yaw: missing; found t, segment, u_roll": lambda columns: columns.pop("u_yaw"),
    "column p_y: missing; found only p_x, p_z of it": lambda columns: columns.pop("p_y"),
    "{row 4}, column v_y: found '?nan'?, expected a finite number": set_cell("v_y", 4, np.nan),
    "found no rows": lambda columns: columns.update({name: one[:0] for name, one in columns.items()}),
    r"{row 4}, column t: found -1\.0, expected a later time": set_cell("t", 4, -1.0),
    r"{row 2}, column segment: found 0\.5, expected a whole number": segments(0, 0, 0.5, 1, 1, 1),
    r"{row 3}, column segment: found 4\.0, expected each number in one piece": segments(4, 4, 2, 4, 2, 2),
    r"{row 0}, column q_w, q_x, q_y, q_z: found 1\.0.*, expected a quaternion of norm 1 within 0\.01": (
        lambda columns: columns.update({f"q_{axis}": columns[f"q_{axis}"] * 1.02 for axis in "wxyz"})
    ),
    r"{row 1}, column u_yaw: found -1\.00001, expected a command in \[-1, 1\]$": set_cell(
        "u_yaw", 1, -1.00001
    ),
}


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("expected", BAD_COLUMNS)
def test_bad_columns_are_refused(expected, suffix, tmp_path):
    path, columns = tmp_path / f"flight{suffix}", columns_of(make_log())
    BAD_COLUMNS[expected](columns)
    write(path, columns)
    line = r"row \1 \\(line {}\\)" if suffix == ".csv" else r"row \1"
    expected = re.sub(r"{row (\d)}", lambda row: row.expand(line).format(int(row[1]) + 2), expected)
    with pytest.raises(LogError, match=f"^{re.escape(str(path))}: {expected}"):
        load_log(path)


@pytest.mark.parametrize("value", [1.0 + 5e-7, -1.0])
def test_full_stick_within_rounding_is_fine(value, tmp_path):
    write(tmp_path / "flight.npz", {**columns_of(make_log()), "u_roll": np.full(NUM_ROWS, value)})
    assert (load_log(tmp_path / "flight.npz")["u"][:, 0] == value).all()


BAD_ARRAYS = {
    "w_x: found pickled objects, .*nothing is unpickled": np.array([Trap()] * NUM_ROWS),
    "column w_x: found an array of <U1, shape .* expected a row of numbers": np.array(["1"] * NUM_ROWS),
    "w_x: found complex128, expected plain values": np.ones(NUM_ROWS, complex),
    r"column w_x: found an array of float64, shape \(6, 1\)": np.ones((NUM_ROWS, 1)),
    "column w_x: found 5 rows, expected 6 as in t": np.ones(NUM_ROWS - 1),
}


HEADER = "t,u_roll,u_pitch,u_yaw,u_thrust,v_bat"
BAD_TEXTS = {
    "column t: missing; found no column": "",
    "column v_bat: found 2 times, expected once": f"{HEADER},v_bat\n",
    r"row 1 \(line 4\): found 4 cells, expected 6 as in the header": f"{HEADER}\n0,0,0,0,0,1\n\n1,0,0,0\n",
    r"row 0 \(line 2\), column u_yaw: found 'on', expected a finite number": f"{HEADER}\n0,0,0,on,0,1\n",
    r"row 0 \(line 2\), column v_bat: found an empty cell": f"{HEADER}\n0,0,0,0,0, \n",
    "near line 1: not a CSV file": b"\xff\xfe\x00",
}
BAD_FILES = [(".npz", *one) for one in BAD_ARRAYS.items()] + [(".csv", *one) for one in BAD_TEXTS.items()]
BAD_FILES += [(name, "found suffix '.*', expected .npz or .csv", "") for name in (".txt", "")]


@pytest.mark.parametrize(("suffix", "expected", "content"), BAD_FILES)
def test_bad_files_are_refused(suffix, expected, content, tmp_path):
    path = tmp_path / f"flight{suffix}"
    if suffix == ".npz":
        np.savez(path, **{**columns_of(make_log()), "w_x": content})
    else:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(LogError, match=f"{path.name}: {expected}"):
        load_log(path)


@pytest.mark.parametrize(
    ("method", "message"),
    [
        (zipfile.ZIP_DEFLATED, "not an .npz file, or damaged"),
        (zipfile.ZIP_BZIP2, "t: found compression 12, expected deflate"),
    ],
)
def test_array_that_unpacks_to_more_than_announced_is_not_unpacked(tmp_path, method, message):
    header, unpacked = io.BytesIO(), 64 * 2**20
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (1000,)})
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", method) as archive:
        for column in REQUIRED:
            archive.writestr(f"{column}.npy", header.getvalue() + bytes(unpacked if column == "t" else 8000))
        archive.getinfo("t.npy").file_size = len(header.getvalue()) + 8 * 1000
    tracemalloc.start()
    try:
        with pytest.raises(LogError, match=message):
            load_log(tmp_path / "bomb.npz")
        assert tracemalloc.get_traced_memory()[1] < unpacked / 8
    finally:
        tracemalloc.stop()
