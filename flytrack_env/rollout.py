"""Rollout files: the states and actions of one flight as a plain numeric ``.npy``.

A row is one step, ``[x (21) | u (4)]``, laid out and in the units of ``flytrack_env.state``. Rows
of 22, which have only the thrust of the applied action, are read as well, and, if the caller allows
it, pickled arrays of (x, u) pairs such as the handout's. Nothing else is unpickled, so a foreign
rollout cannot run code.
"""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import ArrayLike

from flytrack_env.files import open_file, write_atomically
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_env.state import ACTION_SIZE, APPLIED_ACTION, STATE_SIZE

ROW_SIZE = STATE_SIZE + ACTION_SIZE
SHORT_ROW_SIZE = ROW_SIZE - 3
EXPECTED = f"a plain numeric array of shape (T, {ROW_SIZE}) or (T, {SHORT_ROW_SIZE}) with T >= 1"
MAX_STEPS = 2**21  # close to six hours at 100 Hz
MAX_ITEM_BYTES = 8
MAX_HEADER_BYTES = 2**16
MAX_BYTES = MAX_HEADER_BYTES + MAX_STEPS * ROW_SIZE * MAX_ITEM_BYTES


class RolloutError(ValueError):
    """A rollout that cannot be used; the message names file, what was found and expected."""


def save_rollout(path: str | Path, states: ArrayLike, actions: ArrayLike) -> None:
    """Write one flight as float32 rows, under a temporary name that is renamed when complete.

    Args:
        states: (T, 21).
        actions: (T, 4); row t is the action commanded in state t.

    Raises:
        RolloutError: wrong shapes, no steps or more than MAX_STEPS, or a number that is not
            finite.
        OSError: the file cannot be written.
    """
    path = Path(path)
    states, actions = np.asarray(states), np.asarray(actions)
    steps = len(states) if states.ndim else 0
    if steps > MAX_STEPS:
        raise RolloutError(f"{path}: found {steps} steps, expected at most {MAX_STEPS}")
    for name, array, size in (("states", states, STATE_SIZE), ("actions", actions, ACTION_SIZE)):
        if array.shape != (steps, size) or steps == 0 or array.dtype.kind not in "fiu":
            found = f"{array.dtype} of shape {array.shape}"
            raise RolloutError(
                f"{path}: {name}: found {found}, expected (T, {size}) numbers, T >= 1"
            )
    content = io.BytesIO()
    np.save(content, _as_rows(path, np.concatenate([states, actions], axis=1)), allow_pickle=False)
    write_atomically(path, content.getvalue())


def load_rollout(path: str | Path, allow_pickle: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return the states (T, 21) and the actions (T, 4) of a rollout file, float32.

    The applied roll, pitch and yaw are NaN if the file lacks them (rows of 22).

    Args:
        allow_pickle: also read files of pickled objects, which runs whatever code they hold; only
            for files from people you trust.

    Raises:
        RolloutError: missing file, not an ``.npy``, pickled objects unless allowed, another shape,
            no steps or more than MAX_STEPS, a file cut short, or a number that is not finite.
    """
    path = Path(path)
    try:
        with open_file(path, MAX_BYTES) as file:
            is_pickled = _check_header(path, file, allow_pickle)
            file.seek(0)
            rows = np.load(file, allow_pickle=is_pickled)
    except RolloutError:
        raise
    except Exception as error:  # whatever unpickling and damaged headers raise
        found = f"{type(error).__name__}: {error_text(error)}"
        raise RolloutError(f"{path}: cannot be read: {found}; expected {EXPECTED}") from error
    rows = _as_rows(path, _rows_of_pairs(path, rows) if is_pickled else rows)
    if rows.shape[1] == SHORT_ROW_SIZE:
        rows = np.insert(rows, [APPLIED_ACTION.start] * (ROW_SIZE - SHORT_ROW_SIZE), np.nan, axis=1)
    return rows[:, :STATE_SIZE], rows[:, STATE_SIZE:]


def load_named_rollouts(
    paths: Sequence[str | Path], allow_pickle: bool = False
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return rollouts by file name without suffix, after the folder's name if file names repeat.

    Each is states (T, 21) and actions (T, 4).

    Args:
        allow_pickle: see ``load_rollout``.

    Raises:
        RolloutError: a file that is no rollout, or two files with the same folder and file name.
    """
    files = [Path(path) for path in paths]
    names = [file.stem for file in files]
    if len(set(names)) < len(names):
        names = [f"{file.resolve().parent.name}_{file.stem}" for file in files]
    if len(set(names)) < len(names):
        raise RolloutError(
            f"found files of the same names: {', '.join(names)}; expected different ones"
        )
    return {name: load_rollout(file, allow_pickle) for name, file in zip(names, files, strict=True)}


def _check_header(path: Path, file: BinaryIO, allow_pickle: bool) -> bool:
    """Return whether a file declares pickled objects, before any data is read.

    Raises:
        RolloutError: pickled objects that are not allowed, or no rollout.
    """
    if np.lib.format.read_magic(file) != (1, 0):  # as NumPy writes it unless a header is very long
        raise RolloutError(f"{path}: found another version of .npy than 1.0, expected {EXPECTED}")
    shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    if dtype.hasobject and allow_pickle:
        return True
    if dtype.hasobject:
        raise RolloutError(
            f"{path}: found pickled objects, expected {EXPECTED}; pickles run the code they hold, "
            "and are read only if allowed"
        )
    if dtype.kind not in "fiu" or dtype.itemsize > MAX_ITEM_BYTES:
        raise RolloutError(f"{path}: found an array of {quote_name(dtype)}, expected {EXPECTED}")
    if len(shape) != 2 or shape[1] not in (ROW_SIZE, SHORT_ROW_SIZE) or shape[0] < 1:
        raise RolloutError(f"{path}: found shape {quote_value(shape)}, expected {EXPECTED}")
    if shape[0] > MAX_STEPS:
        raise RolloutError(
            f"{path}: found {quote_value(shape[0])} steps, expected at most {MAX_STEPS}"
        )
    return False


def _rows_of_pairs(path: Path, pairs: np.ndarray) -> np.ndarray:
    """Return the rows (T, 25) or (T, 22) of an unpickled list of (x, u) pairs."""
    sizes = (STATE_SIZE, SHORT_ROW_SIZE - ACTION_SIZE)
    expected = " or ".join(f"x ({size},) and u ({ACTION_SIZE},)" for size in sizes)
    try:
        rows = [(np.asarray(x, float), np.asarray(u, float)) for x, u in pairs]
    except (TypeError, ValueError) as error:
        raise RolloutError(
            f"{path}: found {error_text(error)}, expected pairs of {expected}"
        ) from error
    shapes = {(x.shape, u.shape) for x, u in rows}
    if len(shapes) != 1 or shapes.isdisjoint(((size,), (ACTION_SIZE,)) for size in sizes):
        raise RolloutError(
            f"{path}: found shapes {quote_value(shapes)}, expected pairs of {expected}, all alike"
        )
    return np.array([np.concatenate(pair) for pair in rows])


def _as_rows(path: Path, rows: np.ndarray) -> np.ndarray:
    """Return rows as contiguous float32, all finite."""
    with np.errstate(
        over="ignore"
    ):  # a double too large for float32 becomes inf, which is refused below
        rows = np.ascontiguousarray(rows, np.float32)
    if not np.isfinite(rows).all():
        step, column = np.argwhere(~np.isfinite(rows))[0]
        found = f"{rows[step, column]} at step {step}, column {column}"
        raise RolloutError(f"{path}: found {found}, expected finite numbers")
    return rows
