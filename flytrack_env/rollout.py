"""Rollout files: the states and actions of one flight as a plain numeric ``.npy``.

A row is one step, ``[x (21) | u (4)]``, laid out and in the units of ``flytrack_env.state``. Files
are read without unpickling, so that a rollout from a stranger cannot run code.
"""

import io
import math
import os
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import ArrayLike

from flytrack_env.files import write_atomically
from flytrack_env.state import ACTION_SIZE, STATE_SIZE

ROW_SIZE = STATE_SIZE + ACTION_SIZE
EXPECTED = f"a plain numeric array of shape (T, {ROW_SIZE}) with T >= 1"


class RolloutError(ValueError):
    """A rollout that cannot be used; the message names file, what was found and expected."""


def save_rollout(path: str | Path, states: ArrayLike, actions: ArrayLike) -> None:
    """Write one flight as float32 rows, under a temporary name that is renamed when complete.

    states: (T, 21), actions: (T, 4); row t is the state and the action commanded in it.

    Raises:
        RolloutError: wrong shapes, no steps, or a number that is not finite.
        OSError: the file cannot be written.
    """
    path = Path(path)
    states, actions = np.asarray(states), np.asarray(actions)
    steps = len(states) if states.ndim else 0
    for name, array, size in (("states", states, STATE_SIZE), ("actions", actions, ACTION_SIZE)):
        if array.shape != (steps, size) or steps == 0 or array.dtype.kind not in "fiu":
            found = f"{array.dtype} of shape {array.shape}"
            raise RolloutError(f"{path}: {name}: found {found}, expected (T, {size}) numbers, T >= 1")
    content = io.BytesIO()
    np.save(content, _as_rows(path, np.concatenate([states, actions], axis=1)), allow_pickle=False)
    write_atomically(path, content.getvalue())


def load_rollout(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the states (T, 21) and the actions (T, 4) of a rollout file, float32.

    Raises:
        RolloutError: missing file, not an ``.npy``, pickled objects, another shape, no steps, a
            file cut short, or a number that is not finite.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            _check_header(path, file)
            rows = np.load(file, allow_pickle=False)
    except OSError as error:
        raise RolloutError(f"{path}: cannot be read: {error}; expected {EXPECTED}") from error
    rows = _as_rows(path, rows)
    return rows[:, :STATE_SIZE], rows[:, STATE_SIZE:]


def _check_header(path: Path, file: BinaryIO) -> None:
    """Refuse, before any data is read, a file whose header does not announce a rollout."""
    try:
        version = npy_format.read_magic(file)
        is_first = version == (1, 0)
        read = npy_format.read_array_header_1_0 if is_first else npy_format.read_array_header_2_0
        shape, _, dtype = read(file)
    except ValueError as error:
        raise RolloutError(f"{path}: not an .npy file: {error}; expected {EXPECTED}") from error
    if dtype.kind not in "fiu":
        found = "an object array (pickled)" if dtype.hasobject else f"an array of {dtype}"
        raise RolloutError(f"{path}: found {found}, expected {EXPECTED}")
    if len(shape) != 2 or shape[1] != ROW_SIZE or shape[0] == 0:
        raise RolloutError(f"{path}: found shape {shape}, expected {EXPECTED}")
    announced = math.prod(shape) * dtype.itemsize
    found_bytes = os.fstat(file.fileno()).st_size - file.tell()
    if found_bytes < announced:
        reason = f"found {found_bytes} bytes of data, expected {announced} for shape {shape}"
        raise RolloutError(f"{path}: cut short: {reason}")
    file.seek(0)


def _as_rows(path: Path, rows: np.ndarray) -> np.ndarray:
    """Return rows (T, 25) as contiguous float32, all finite."""
    # A double too large for float32 becomes inf, which the check below reports in words.
    with np.errstate(over="ignore"):
        rows = np.ascontiguousarray(rows, np.float32)
    if not np.isfinite(rows).all():
        step, column = np.argwhere(~np.isfinite(rows))[0]
        found = f"{rows[step, column]} at step {step}, column {column}"
        raise RolloutError(f"{path}: found {found}, expected finite numbers")
    return rows
