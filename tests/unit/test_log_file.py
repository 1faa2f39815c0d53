"""Files of logs: what is written comes back, and a file is described."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flytrack_sysid.log import CHANNELS, FlightLog, LogError
from flytrack_sysid.log_file import describe, gaps_of, load_log, save_log
from tests.support.written_logs import NUM_ROWS, SUFFIXES, assert_same_log, columns_of, make_log, write


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
    assert found.source == str(path) and found.sha256 != replace(log, time=log.time + 1.0).sha256
    assert num_rows == 1 or found.sha256 == log.sha256
    again = path.with_name(f"again{suffix}")
    save_log(again, found)
    assert again.read_bytes() == path.read_bytes() and len(list(path.parent.iterdir())) == 2


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_one_segment_needs_no_column(suffix, tmp_path):
    path = tmp_path / f"flight{suffix}"
    log = replace(make_log(), segment=np.full(NUM_ROWS, 3))
    save_log(path, log)
    assert b"segment" not in path.read_bytes()
    assert_same_log(load_log(path), replace(log, segment=np.zeros(NUM_ROWS, int)))


def test_files_of_other_writers(tmp_path):
    log = make_log(names=("w",))
    columns = columns_of(log)
    path = tmp_path / "flight.npz"
    np.savez_compressed(path, **{name: values.astype(np.float32) for name, values in columns.items()})
    np.testing.assert_allclose(load_log(path)["w"], log["w"], rtol=1e-6)
    path = tmp_path / "flight.CSV"
    write(path, columns)
    text = path.read_text(encoding="utf-8").replace(",", " , ").replace("\n", "\r\n\r\n")
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert_same_log(load_log(path), log)


def test_quaternions_drift_a_little_and_may_flip(tmp_path):
    log = make_log(names=("q",))
    factors = np.array([1.0, -1.0, 1.005, -0.995, 1.0, 1.0])[:, None]
    write(
        tmp_path / "flight.csv", columns_of(replace(log, channels={**log.channels, "q": factors * log["q"]}))
    )
    found = load_log(tmp_path / "flight.csv")["q"]
    np.testing.assert_allclose(found, np.sign(factors) * log["q"], atol=1e-12)


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


def test_gaps_are_long_steps_within_a_segment():
    # Two flights at different rates with a pause between; one sample lost in the first, two in the second.
    first, second = np.delete(np.arange(10), 4) * 0.01, 9.0 + np.delete(np.arange(12), [6, 7]) * 0.1
    time = np.concatenate([first, second, [20.0]])
    segment = np.repeat([0, 1, 2], [len(first), len(second), 1])
    log = FlightLog(time, {"u": np.zeros((len(time), 4))}, segment)
    np.testing.assert_array_equal(gaps_of(log), [3, len(first) + 5])
    assert len(gaps_of(log.select(slice(0)))) == 0
    jitter = np.random.default_rng(0).uniform(-0.002, 0.002, 200)
    steady = FlightLog(np.arange(200) * 0.01 + jitter, {"u": np.zeros((200, 4))}, np.zeros(200, int))
    assert len(gaps_of(steady)) == 0
    assert "gaps: none" in describe(steady)
