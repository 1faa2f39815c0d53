"""Rollout files: what is written comes back, and everything else is refused with a reason."""

import tracemalloc

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from flytrack_env.rollout import RolloutError, load_rollout, save_rollout
from tests.support.recordings import make_flight
from tests.support.written_logs import npy_bytes


@pytest.mark.parametrize("steps", [1, 300])
def test_round_trip_is_exact(tmp_path, steps):
    states, actions = make_flight(steps)
    save_rollout(tmp_path / "flight", states, actions)
    assert [path.name for path in tmp_path.iterdir()] == ["flight"]
    for array, expected in zip(load_rollout(tmp_path / "flight"), (states, actions), strict=True):
        assert_array_equal(array, expected)
        assert array.dtype == np.float32
    rows = np.load(tmp_path / "flight", allow_pickle=False)
    assert_array_equal(rows, np.hstack([states, actions]))


def rows_with(value):
    rows = np.zeros((3, 25))
    rows[1, 9] = value
    return npy_bytes(rows)


def pairs_of(*pairs):
    array = np.empty(len(pairs), object)
    array[:] = pairs
    return array


class Unreadable:
    """Cannot be unpickled."""

    def __reduce__(self):
        return (int, ("no number",))


ROWS = npy_bytes(np.zeros((3, 25)))
BAD_FILES = {
    "cannot be read: ValueError": b"step,x,y,z\n0,1,2,3\n",
    "cannot be read: ValueError: .*75": ROWS[:-8],
    "found an array of <U1": npy_bytes(np.full((3, 25), "a")),
    r"found shape \(3, 23\), expected .*\(T, 25\) or \(T, 22\)": npy_bytes(np.zeros((3, 23))),
    r"found shape \(0, 25\), expected .*T >= 1": npy_bytes(np.zeros((0, 25))),
    "found nan at step 1, column 9, expected finite": rows_with(np.nan),
    "found inf at step 1": rows_with(1e300),  # beyond float32
    "found another version of .npy": b"\x93NUMPY\x09\x09" + bytes(99),
    "found an array of .{1,250}, exp": npy_bytes(np.zeros(3, [("a" * 900, "<f8")])),
    "found 3000000000000 steps": ROWS.replace(b"(3, 25), }" + b" " * 12, b"(3000000000000, 25), }"),
    "found shapes set": np.empty((0, 2), object),
    r"found shapes {\(\(17,\), \(4,\)\)}, expected pairs": pairs_of((np.zeros(17), np.zeros(4))),
    "expected pairs of x": pairs_of(("a", "b")),
    "found nan at step 0": pairs_of((np.full(21, np.nan), np.zeros(4))),
    "cannot be read: ValueError: invalid": pairs_of((Unreadable(), 0)),
}


@pytest.mark.parametrize("reason", BAD_FILES)
def test_bad_files_are_refused_before_memory_is_allocated(tmp_path, reason):
    path = tmp_path / "flight.npy"
    content = BAD_FILES[reason]
    is_pickle = isinstance(content, np.ndarray)
    if is_pickle:
        np.save(path, content, allow_pickle=True)
    else:
        path.write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(RolloutError, match=reason) as caught:
            load_rollout(path, allow_pickle=is_pickle)
        assert str(path) in str(caught.value) and tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("is_short", [False, True])
@pytest.mark.parametrize("layout", ["rows", "pairs", "columns"])
def test_layouts_are_read_and_pickles_only_if_allowed(tmp_path, layout, is_short):
    """Short rows lack the applied rate actions."""
    path, (states, actions) = tmp_path / "flight.npy", make_flight(5)
    rows = np.delete(states, (16, 17, 18), axis=1) if is_short else states
    layouts = {
        "rows": np.hstack([rows, actions]),
        "pairs": pairs_of(*zip(rows, actions, strict=True)),
        "columns": np.stack([pairs_of(*rows), pairs_of(*actions)], axis=1),
    }
    np.save(path, layouts[layout], allow_pickle=True)
    if layout != "rows":
        with pytest.raises(RolloutError, match=r"found pickled objects.* only if allowed"):
            load_rollout(path)
    if is_short:
        states[:, 16:19] = np.nan
    read_states, read_actions = load_rollout(path, allow_pickle=layout != "rows")
    assert_array_equal(read_states, states)
    assert_array_equal(read_actions, actions)
