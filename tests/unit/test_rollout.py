"""Rollout files: what is written comes back, and everything else is refused with a reason."""

import io
import pickle
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest

from flytrack_env import rollout
from flytrack_env.rollout import RolloutError, load_rollout, save_rollout


def make_flight(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return random states (T, 21) and actions (T, 4), float32."""
    rng = np.random.default_rng(steps)
    states = rng.normal(size=(steps, 21)).astype(np.float32)
    return states, rng.uniform(-1, 1, (steps, 4)).astype(np.float32)


@pytest.mark.parametrize("steps", [1, 300])
def test_round_trip_is_exact(tmp_path, steps):
    states, actions = make_flight(steps)
    save_rollout(tmp_path / "flight.npy", states, actions)
    read_states, read_actions = load_rollout(tmp_path / "flight.npy")
    np.testing.assert_array_equal(read_states, states)
    np.testing.assert_array_equal(read_actions, actions)
    assert read_states.dtype == read_actions.dtype == np.float32


def test_file_is_a_plain_array_of_rows(tmp_path):
    states, actions = make_flight(7)
    save_rollout(tmp_path / "flight.npy", states, actions)
    rows = np.load(tmp_path / "flight.npy", allow_pickle=False)
    assert rows.dtype == np.float32
    np.testing.assert_array_equal(rows, np.hstack([states, actions]))


def test_name_is_kept_and_nothing_lies_beside_it(tmp_path):
    save_rollout(tmp_path / "flight", *make_flight(2))
    assert [path.name for path in tmp_path.iterdir()] == ["flight"]


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", [np.float64, np.float16, np.int32])
def test_any_plain_numbers_are_read_as_float32(tmp_path, dtype, order):
    rows = np.asarray(np.arange(75).reshape(3, 25), dtype=dtype, order=order)
    np.save(tmp_path / "flight.npy", rows)
    states, actions = load_rollout(tmp_path / "flight.npy")
    assert states.dtype == np.float32
    np.testing.assert_array_equal(np.hstack([states, actions]), rows.astype(np.float32))


def npy_bytes(array: np.ndarray) -> bytes:
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


def npz_bytes() -> bytes:
    content = io.BytesIO()
    np.savez(content, rows=np.zeros((3, 25)))
    return content.getvalue()


def rows_with(value: float) -> np.ndarray:
    rows = np.zeros((3, 25))
    rows[1, 9] = value
    return rows


PAIRS = [(np.zeros(21), np.zeros(4))] * 3
BAD_FILES = {
    "no bytes": (b"", "not an .npy"),
    "text": (b"step,x,y,z\n0,1,2,3\n", "not an .npy"),
    "pickle": (pickle.dumps(PAIRS), "not an .npy"),
    "npz": (npz_bytes(), "not an .npy"),
    "header cut": (npy_bytes(np.zeros((3, 25)))[:40], "not an .npy"),
    "data cut": (npy_bytes(np.zeros((3, 25)))[:-8], "cut short: found 592 bytes.*expected 600"),
    "objects": (npy_bytes(np.array([[None, None]] * 3, object)), "found an object array"),
    "text array": (npy_bytes(np.full((3, 25), "a")), "found an array of <U1"),
    "complex": (npy_bytes(np.zeros((3, 25), complex)), "found an array of complex128"),
    "other layout": (
        npy_bytes(np.zeros((3, 23))),
        r"found shape \(3, 23\), expected .*\(T, 25\) or \(T, 22\)",
    ),
    "short row with nan": (npy_bytes(np.full((3, 22), np.nan)), "found nan at step 0, column 0"),
    "one row": (npy_bytes(np.zeros(25)), r"found shape \(25,\)"),
    "no steps": (npy_bytes(np.zeros((0, 25))), r"found shape \(0, 25\), expected .*T >= 1"),
    "nan": (npy_bytes(rows_with(np.nan)), "found nan at step 1, column 9, expected finite"),
    "inf": (npy_bytes(rows_with(np.inf)), "found inf at step 1"),
    "long doubles": (npy_bytes(np.zeros((3, 25), np.longdouble)), "found an array of float128"),
    "unknown version": (b"\x93NUMPY\x09\x09" + bytes(99), r"not an .npy file: found version \(9, 9\)"),
    "long header": (
        npy_bytes(np.zeros((3, 25), np.dtype([("a", "<f8")] * 1)))[:8] + b"\xff" * 2 + b"x" * 99,
        "not an .npy file: EOF",
    ),
    "structure of many names": (
        npy_bytes(np.zeros(3, [("a" * 900, "<f8")])),
        "found an array of .{1,250}, exp",
    ),
    "beyond float32": (npy_bytes(rows_with(1e300)), "found inf at step 1"),
}


def test_short_rows_are_read_and_what_they_lack_is_a_gap(tmp_path):
    """[position, velocity, acceleration, quaternion, rates, previous thrust, battery | u]."""
    states, actions = make_flight(6)
    short = np.hstack([states[:, :16], states[:, 19:], actions])
    assert short.shape == (6, 22)
    np.save(tmp_path / "flight.npy", short)
    read_states, read_actions = load_rollout(tmp_path / "flight.npy")
    assert np.isnan(read_states[:, 16:19]).all()
    states[:, 16:19] = np.nan
    np.testing.assert_array_equal(read_states, states)
    np.testing.assert_array_equal(read_actions, actions)


def pickled(form: str, size: int, steps: int = 5) -> np.ndarray:
    """Return a flight as the handout's object arrays, (T, 2) or a list of pairs."""
    states, actions = make_flight(steps)
    if size == 18:
        states = np.delete(states, (16, 17, 18), axis=1)
    pairs = np.empty((steps, 2) if form == "columns" else steps, object)
    for step, pair in enumerate(zip(states, actions, strict=True)):
        pairs[step] = pair
    return pairs


@pytest.mark.parametrize("size", [21, 18])
@pytest.mark.parametrize("form", ["columns", "pairs"])
def test_pickled_pairs_are_read_only_where_allowed(tmp_path, form, size):
    path = tmp_path / "flight.npy"
    np.save(path, pickled(form, size), allow_pickle=True)
    with pytest.raises(RolloutError, match=r"object array \(pickled; read only if"):
        load_rollout(path)
    states, actions = make_flight(5)
    if size == 18:
        states[:, 16:19] = np.nan
    read_states, read_actions = load_rollout(path, allow_pickle=True)
    np.testing.assert_array_equal(read_states, states)
    np.testing.assert_array_equal(read_actions, actions)


def test_plain_files_are_read_alike_where_pickles_are_allowed(tmp_path):
    states, actions = make_flight(4)
    save_rollout(tmp_path / "flight.npy", states, actions)
    read = load_rollout(tmp_path / "flight.npy", allow_pickle=True)
    np.testing.assert_array_equal(np.hstack(read), np.hstack([states, actions]))


def objects(*pairs: object) -> np.ndarray:
    array = np.empty(len(pairs), object)
    array[:] = pairs
    return array


class Unreadable:
    """Cannot be unpickled."""

    def __reduce__(self):
        return (int, ("no number",))


GOOD_PAIR = (np.zeros(21), np.zeros(4))
BAD_OBJECTS = {
    "no pairs": (np.empty((0, 2), object), "found objects of shape"),
    "other state": (objects((np.zeros(17), np.zeros(4))), r"step 0: found shapes \(17,\) and \(4,\)"),
    "two kinds": (objects(GOOD_PAIR, (np.zeros(18), np.zeros(4))), "step 1: .*alike in all steps"),
    "no pair": (objects(GOOD_PAIR, None), "step 1: .*expected a pair"),
    "words": (objects(("a", "b")), "step 0: .*expected a pair"),
    "nan": (objects((np.full(21, np.nan), np.zeros(4))), "found nan at step 0"),
    "broken": (objects((Unreadable(), 0)), "cannot be read: ValueError"),
}


@pytest.mark.parametrize("case", BAD_OBJECTS)
def test_bad_pickled_objects_are_refused(tmp_path, case):
    content, reason = BAD_OBJECTS[case]
    np.save(tmp_path / "flight.npy", content, allow_pickle=True)
    with pytest.raises(RolloutError, match=reason):
        load_rollout(tmp_path / "flight.npy", allow_pickle=True)


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_file_is_refused(tmp_path, case):
    content, reason = BAD_FILES[case]
    path = tmp_path / "flight.npy"
    path.write_bytes(content)
    with pytest.raises(RolloutError, match=reason) as caught:
        load_rollout(path)
    assert str(path) in str(caught.value)


def test_object_array_is_refused_without_unpickling(tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    rows = np.empty((1, 2), object)
    rows[0] = Trap(), Trap()
    np.save(tmp_path / "flight.npy", rows)
    with pytest.raises(RolloutError, match="object array"):
        load_rollout(tmp_path / "flight.npy")
    assert not (tmp_path / "sprung").exists()


def test_shape_larger_than_the_file_is_refused_before_allocating(tmp_path):
    content = npy_bytes(np.zeros((3, 25), np.float32))
    huge = content.replace(b"(3, 25), }" + b" " * 12, b"(3000000000000, 25), }")
    path = tmp_path / "flight.npy"
    path.write_bytes(huge)
    assert len(huge) == len(content) and huge != content
    with pytest.raises(RolloutError, match="cut short"):
        load_rollout(path)


def test_header_larger_than_any_is_not_made_room_for(tmp_path):
    path = tmp_path / "flight.npy"
    path.write_bytes(b"\x93NUMPY\x02\x00\xff\xff\xff\x7f{'descr'" + bytes(200))
    tracemalloc.start()
    try:
        with pytest.raises(RolloutError, match=r"not an \.npy file: found a header of 2147483647 bytes"):
            load_rollout(path)
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def test_rollouts_of_too_many_steps_are_neither_read_nor_written(tmp_path, monkeypatch):
    states, actions = make_flight(6)
    save_rollout(tmp_path / "flight.npy", states, actions)
    monkeypatch.setattr(rollout, "MOST_STEPS", 5)
    with pytest.raises(RolloutError, match=r"flight\.npy: found 6 steps, expected at most 5"):
        load_rollout(tmp_path / "flight.npy")
    with pytest.raises(RolloutError, match=r"other\.npy: found 6 steps, expected at most 5"):
        save_rollout(tmp_path / "other.npy", states, actions)
    assert not (tmp_path / "other.npy").exists()


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(RolloutError, match=r"absent\.npy: cannot be read"):
        load_rollout(tmp_path / "absent.npy")


@pytest.mark.parametrize(
    ("states", "actions", "reason"),
    [
        (np.zeros((3, 17)), np.zeros((3, 4)), r"states: found .*\(3, 17\), expected \(T, 21\)"),
        (np.zeros((3, 21)), np.zeros((2, 4)), r"actions: found .*\(2, 4\)"),
        (np.zeros((0, 21)), np.zeros((0, 4)), r"states: found .*\(0, 21\)"),
        (np.zeros(21), np.zeros(4), r"states: found .*\(21,\)"),
        (np.full((3, 21), np.nan), np.zeros((3, 4)), "found nan at step 0"),
        (np.zeros((3, 21)), np.full((3, 4), np.inf), "found inf at step 0, column 21"),
    ],
)
def test_bad_arrays_are_not_written(tmp_path, states, actions, reason):
    with pytest.raises(RolloutError, match=reason):
        save_rollout(tmp_path / "flight.npy", states, actions)
    assert list(tmp_path.iterdir()) == []


def test_package_does_without_rerun_and_its_viewer_says_what_to_install():
    script = (
        "import sys, flytrack_env, flytrack_env.rollout; assert 'rerun' not in sys.modules;"
        "sys.modules['rerun'] = None; import flytrack_env.viz_rerun"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    last = done.stderr.strip().splitlines()[-1]
    assert done.returncode == 1
    assert last.startswith("ImportError: recordings need rerun-sdk") and "flytrack[viz]" in last
