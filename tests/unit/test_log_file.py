"""Log files are written and read back, described, or refused with file and reason."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flytrack_sysid.log import CHANNELS, FlightLog, LogError
from flytrack_sysid.log_file import describe, gaps_of, load_log, save_log
from tests.support.tables import table
from tests.support.written_logs import (
    NUM_ROWS,
    SUFFIXES,
    assert_same_log,
    columns_of,
    make_log,
    with_channels,
    write,
)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    num_rows=st.integers(1, 20),
    names=st.sets(st.sampled_from(list(CHANNELS))),
    suffix=st.sampled_from(SUFFIXES),
    number=st.floats(allow_nan=False, allow_infinity=False),
)
def test_any_log_comes_back(seed, num_rows, names, suffix, number, tmp_path_factory):
    log = make_log(seed, num_rows, tuple(names))
    if "p" in log:
        log["p"][-1, 1] = number
    path = tmp_path_factory.mktemp("log") / "new" / f"flight{suffix}"
    save_log(path, log)
    found = load_log(str(path))
    one_segment = replace(log, segment=np.zeros(num_rows, int))
    assert_same_log(found, log if num_rows > 1 else one_segment)
    assert (b"segment" in path.read_bytes()) == (num_rows > 1)
    assert found.source == str(path) and found.sha256 != replace(log, time=log.time + 1.0).sha256
    assert num_rows == 1 or found.sha256 == log.sha256
    again = path.with_name(f"again{suffix}")
    save_log(again, found)
    assert again.read_bytes() == path.read_bytes() and len(list(path.parent.iterdir())) == 2


def test_files_of_other_writers(tmp_path):
    log = make_log(names=("w",))
    columns = columns_of(log)
    path = tmp_path / "flight.npz"
    np.savez_compressed(
        path, **{name: values.astype(np.float32) for name, values in columns.items()}
    )
    np.testing.assert_allclose(load_log(path)["w"], log["w"], rtol=1e-6)
    path = tmp_path / "flight.CSV"
    write(path, columns)
    text = path.read_text(encoding="utf-8").replace(",", " , ").replace("\n", "\r\n\r\n")
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert_same_log(load_log(path), log)


def test_quaternions_drift_a_little_and_may_flip_and_full_stick_is_rounded(tmp_path):
    log = make_log(names=("q",))
    factors = np.array([1.0, -1.0, 1.005, -0.995, 1.0, 1.0])[:, None]
    log["u"][:, 0] = 1.0 + 5e-7
    write(tmp_path / "flight.csv", columns_of(with_channels(log, q=factors * log["q"])))
    loaded = load_log(tmp_path / "flight.csv")
    np.testing.assert_allclose(loaded["q"], np.sign(factors) * log["q"], atol=1e-12)
    assert (loaded["u"][:, 0] == 1.0 + 5e-7).all()


def test_what_would_be_refused_is_not_written(tmp_path):
    log = make_log()
    bad = replace(log, time=log.time[::-1])
    for name, wrong, expected in (
        ("flight.csv", bad, "row 1, column t: "),
        ("flight.npz", log.select(slice(0)), "found no rows"),
        ("flight.mat", log, "found suffix '.mat'"),
    ):
        with pytest.raises(LogError, match=f"{name}: {expected}"):
            save_log(tmp_path / name, wrong)
    assert list(tmp_path.iterdir()) == []


def log_at(time, segment):
    return FlightLog(time, {"u": np.zeros((len(time), 4))}, segment)


def test_gaps_are_long_steps_within_a_segment():
    """One sample lost in a flight at 100 Hz, two in one at 10 Hz, and a pause between them."""
    first, second = np.delete(np.arange(10), 4) * 0.01, 9.0 + np.delete(np.arange(12), [6, 7]) * 0.1
    log = log_at(np.concatenate([first, second, [20.0]]), np.repeat([0, 1, 2], [9, 10, 1]))
    np.testing.assert_array_equal(gaps_of(log), [3, 9 + 5])
    assert len(gaps_of(log.select(slice(0)))) == 0
    jitter = np.random.default_rng(0).uniform(-0.002, 0.002, 200)
    steady = log_at(np.arange(200) * 0.01 + jitter, np.zeros(200, int))
    assert len(gaps_of(steady)) == 0 and "gaps: none" in describe(steady)


# --- Flight log files: every refusal names file and reason, quickly and in little memory ----------


def cell(column, row, value):
    return lambda columns: columns[column].__setitem__(row, value)


def rename(old, new):
    return lambda columns: columns.update({new: columns.pop(old)})


def segments(*values):
    return lambda columns: columns.update(segment=np.array(values))


# What the message says after the file, {row} with the line in a CSV file; and what is done to the
# columns.
BAD_COLUMNS = {
    r"column 'w_roll': unknown; .*\(known: t, segment, u_roll, ": rename("w_x", "w_roll"),
    "column t: missing; found ": rename("t", "segment"),
    "column u_yaw: missing; found t, segment, u_roll": lambda columns: columns.pop("u_yaw"),
    "column p_y: missing; found only p_x, p_z of it": lambda columns: columns.pop("p_y"),
    "{row 4}, column v_y: found '?nan'?, expected a finite number": cell("v_y", 4, np.nan),
    r"{row 4}, column t: found -1\.0, expected a later time": cell("t", 4, -1.0),
    r"{row 2}, column segment: found 0\.5, expected a whole number": segments(0, 0, 0.5, 1, 1, 1),
    r"{row 3}, column segment: found 4\.0, expected each number in one piece": segments(
        4, 4, 2, 4, 2, 2
    ),
    r"{row 0}, column q_w, q_x, q_y, q_z: found 1\.0.*, expected a quaternion of norm 1": (
        lambda columns: columns.update(
            {f"q_{axis}": columns[f"q_{axis}"] * 1.02 for axis in "wxyz"}
        )
    ),
    r"{row 1}, column u_yaw: found -1\.00001, expected a command": cell("u_yaw", 1, -1.00001),
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


BAD_ARRAYS = {
    "column w_x: found an array of complex128": np.ones(NUM_ROWS, complex),
    r"column w_x: found an array of float64, shape \(6, 1\)": np.ones((NUM_ROWS, 1)),
    "column w_x: found 5 rows, expected 6 as in t": np.ones(NUM_ROWS - 1),
}


BAD_FILES = [(".npz", *one) for one in BAD_ARRAYS.items()] + [
    (".csv", *one) for one in table("bad_logs").items()
]
BAD_FILES += [(name, "found suffix '.*', expected .npz or .csv", "") for name in (".txt", "")]


@pytest.mark.parametrize(("suffix", "expected", "content"), BAD_FILES)
def test_bad_files_are_refused(suffix, expected, content, tmp_path):
    path = tmp_path / f"flight{suffix}"
    if suffix == ".npz":
        np.savez(path, **{**columns_of(make_log()), "w_x": content})
    else:
        path.write_text(content)
    with pytest.raises(LogError, match=f"{path.name}: {expected}"):
        load_log(path)
