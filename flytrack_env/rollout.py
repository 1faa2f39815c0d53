"""Rollout files: the states and actions of one flight as a plain numeric ``.npy``.

A row is one step, ``[x (21) | u (4)]``, laid out and in the units of ``flytrack_env.state``; that is
what is written. Read are also rows of 22, which have of the applied action the thrust only, and, where the
caller allows it, pickled arrays of (x, u) pairs, such as the handout's. Nothing else is unpickled, so that
a rollout from a stranger cannot run code.
"""

import io
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import ArrayLike

from flytrack_env.files import open_file, write_atomically
from flytrack_env.messages import error_text, quote_value
from flytrack_env.npz_file import read_header
from flytrack_env.state import ACTION_SIZE, APPLIED_ACTION, STATE_SIZE

ROW_SIZE = STATE_SIZE + ACTION_SIZE
SHORT_ROW_SIZE = ROW_SIZE - 3
EXPECTED = f"a plain numeric array of shape (T, {ROW_SIZE}) or (T, {SHORT_ROW_SIZE}) with T >= 1"
MOST_STEPS = 2**21  # close to six hours at 100 Hz; with the copies made of them, below 1 GiB
LARGEST_ITEM_BYTES = 8
LONGEST_TEXT = 200  # characters of what a header says
PICKLED = "read only if pickles are allowed, as unpickling runs what the file holds"


class RolloutError(ValueError):
    """A rollout that cannot be used; the message names file, what was found and expected."""


def save_rollout(path: str | Path, states: ArrayLike, actions: ArrayLike) -> None:
    """Write one flight as float32 rows, under a temporary name that is renamed when complete.

    states: (T, 21), actions: (T, 4); row t is the state and the action commanded in it.

    Raises:
        RolloutError: wrong shapes, no steps or more than MOST_STEPS, or a number that is not finite.
        OSError: the file cannot be written.
    """
    path = Path(path)
    states, actions = np.asarray(states), np.asarray(actions)
    steps = len(states) if states.ndim else 0
    if steps > MOST_STEPS:
        raise RolloutError(f"{path}: found {steps} steps, expected at most {MOST_STEPS}")
    for name, array, size in (("states", states, STATE_SIZE), ("actions", actions, ACTION_SIZE)):
        if array.shape != (steps, size) or steps == 0 or array.dtype.kind not in "fiu":
            found = f"{array.dtype} of shape {array.shape}"
            raise RolloutError(f"{path}: {name}: found {found}, expected (T, {size}) numbers, T >= 1")
    content = io.BytesIO()
    np.save(content, _as_rows(path, np.concatenate([states, actions], axis=1)), allow_pickle=False)
    write_atomically(path, content.getvalue())


def load_rollout(path: str | Path, allow_pickle: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return the states (T, 21) and the actions (T, 4) of a rollout file, float32.

    The roll, pitch and yaw that were applied are NaN where the file does not have them: in rows of 22.
    allow_pickle: also read files of pickled objects, which runs whatever code they hold: only for files
    from those you trust.

    Raises:
        RolloutError: missing file, not an ``.npy``, pickled objects unless allowed, another shape, no
            steps or more than MOST_STEPS, a file cut short, or a number that is not finite.
    """
    path = Path(path)
    try:
        with open_file(path) as file:
            is_pickled = _check_header(path, file, allow_pickle)
            rows = np.load(file, allow_pickle=is_pickled)
    except OSError as error:
        raise RolloutError(f"{path}: cannot be read: {error_text(error)}; expected {EXPECTED}") from error
    except RolloutError:
        raise
    except (Exception, SystemExit) as error:  # whatever unpickling and damaged headers raise
        found = f"{type(error).__name__}: {error_text(error)}"
        raise RolloutError(f"{path}: cannot be read: {found}; expected {EXPECTED}") from error
    if is_pickled:
        rows = _rows_of_pairs(path, rows)
    rows = _widened(_as_rows(path, rows))
    return rows[:, :STATE_SIZE], rows[:, STATE_SIZE:]


def load_named_rollouts(
    paths: Sequence[str | Path], allow_pickle: bool = False
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return rollouts by a short name: that of the file, after that of its folder where files are alike.

    Each is states (T, 21) and actions (T, 4). allow_pickle: see ``load_rollout``.

    Raises:
        RolloutError: a file that is no rollout, or two files of the same names.
    """
    files = [Path(path) for path in paths]
    names = [file.stem for file in files]
    if len(set(names)) < len(names):
        names = [f"{file.resolve().parent.name}_{file.stem}" for file in files]
    taken: dict[str, Path] = {}
    for name, file in zip(names, files, strict=True):
        if name in taken:
            raise RolloutError(
                f"{file}: found the name {name!r}, which {taken[name]} has, expected one of its own"
            )
        taken[name] = file
    return {name: load_rollout(file, allow_pickle) for name, file in taken.items()}


def _check_header(path: Path, file: BinaryIO, allow_pickle: bool) -> bool:
    """Return whether the file is pickled; refuse, before any data is read, what announces no rollout."""
    try:
        shape, _, dtype = read_header(file)
    except ValueError as error:
        raise RolloutError(f"{path}: not an .npy file: {error_text(error)}; expected {EXPECTED}") from error
    if dtype.hasobject and allow_pickle:
        file.seek(0)
        return True
    if dtype.kind not in "fiu" or dtype.itemsize > LARGEST_ITEM_BYTES:
        array = f"an array of {str(dtype)[:LONGEST_TEXT]}"
        found = f"an object array (pickled; {PICKLED})" if dtype.hasobject else array
        raise RolloutError(f"{path}: found {found}, expected {EXPECTED}")
    if len(shape) != 2 or shape[1] not in (ROW_SIZE, SHORT_ROW_SIZE) or shape[0] < 1 or shape[0] is True:
        raise RolloutError(f"{path}: found shape {quote_value(shape)}, expected {EXPECTED}")
    announced = math.prod(shape) * dtype.itemsize
    found_bytes = os.fstat(file.fileno()).st_size - file.tell()
    if found_bytes < announced:
        expected = f"{quote_value(announced)} for shape {quote_value(shape)}"
        raise RolloutError(f"{path}: cut short: found {found_bytes} bytes of data, expected {expected}")
    if shape[0] > MOST_STEPS:
        raise RolloutError(f"{path}: found {shape[0]} steps, expected at most {MOST_STEPS}")
    file.seek(0)
    return False


def _rows_of_pairs(path: Path, pairs: np.ndarray) -> np.ndarray:
    """Return the rows (T, 25) or (T, 22) of an unpickled list of (x, u) pairs."""
    sizes = {ROW_SIZE: STATE_SIZE, SHORT_ROW_SIZE: SHORT_ROW_SIZE - ACTION_SIZE}
    expected = " or ".join(f"x ({size},) and u ({ACTION_SIZE},)" for size in sizes.values())
    if np.ndim(pairs) not in (1, 2) or len(pairs) == 0:
        raise RolloutError(f"{path}: found objects of shape {np.shape(pairs)}, expected pairs of {expected}")
    rows: list[np.ndarray] = []
    for step, pair in enumerate(pairs):
        try:
            x, u = (np.asarray(part, float) for part in pair)
        except (TypeError, ValueError) as error:
            raise RolloutError(
                f"{path}: step {step}: {error_text(error)}; expected a pair of {expected}"
            ) from error
        size = sizes.get(len(rows[0])) if rows else x.size
        if u.shape != (ACTION_SIZE,) or x.shape != (size,) or size not in sizes.values():
            found = f"shapes {x.shape} and {u.shape}"
            raise RolloutError(f"{path}: step {step}: found {found}, expected {expected}, alike in all steps")
        rows.append(np.concatenate([x, u]))
    return np.array(rows)


def _widened(rows: np.ndarray) -> np.ndarray:
    """Return rows (T, 25) of rows that may lack the applied roll, pitch and yaw, which then are NaN."""
    if rows.shape[1] == ROW_SIZE:
        return rows
    missing = np.full((len(rows), ROW_SIZE - SHORT_ROW_SIZE), np.nan, np.float32)
    before = APPLIED_ACTION.start
    return np.concatenate([rows[:, :before], missing, rows[:, before:]], axis=1)


def _as_rows(path: Path, rows: np.ndarray) -> np.ndarray:
    """Return rows as contiguous float32, all finite."""
    # A double too large for float32 becomes inf, which the check below reports in words.
    with np.errstate(over="ignore"):
        rows = np.ascontiguousarray(rows, np.float32)
    if not np.isfinite(rows).all():
        step, column = np.argwhere(~np.isfinite(rows))[0]
        found = f"{rows[step, column]} at step {step}, column {column}"
        raise RolloutError(f"{path}: found {found}, expected finite numbers")
    return rows
