"""Wrong readings of a channel's axes: the 48 signed permutations, and of a quaternion's columns.

A signed permutation ``T`` says what the columns of a log hold: ``logged = T @ true``. Its name
lists the true axis in each column, such as "x -y -z" for FRD columns that were taken for FLU.
"""

from collections.abc import Callable
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

AXES = "xyz"


def _all_frames() -> np.ndarray:
    """Return the signed permutations, (48, 3, 3), simplest first."""
    frames = [
        np.diag(signs) @ np.eye(3)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return np.array(
        sorted(frames, key=lambda frame: (num_changed(frame), np.linalg.det(frame) < 0))
    )


def num_changed(frame: np.ndarray) -> int:
    """Return how many columns of a log a frame changes."""
    return int(np.sum(np.any(frame != np.eye(3), axis=1)))


FRAMES = _all_frames()
NUM_FRAMES = len(FRAMES)
IDENTITY = 0
_NUMBER = {frame.tobytes(): number for number, frame in enumerate(FRAMES + 0.0)}


def number_of(frame: np.ndarray) -> int:
    """Return the row of ``FRAMES`` that holds a signed permutation."""
    return _NUMBER[(np.round(frame) + 0.0).tobytes()]


PRODUCT = np.array([[number_of(one @ other) for other in FRAMES] for one in FRAMES])
INVERSE = np.array([number_of(frame.T) for frame in FRAMES])
ROTATIONS = np.flatnonzero(np.linalg.det(FRAMES) > 0.0)  # numbers of the frames without mirrors
DIRECTIONS = np.concatenate([np.eye(3)[::-1], -np.eye(3)[::-1]])  # (6, 3); the first is z
UP_OF = np.array([int(np.argmax(DIRECTIONS @ frame[:, 2])) for frame in FRAMES])  # where z goes
COSTS = np.array([num_changed(frame) for frame in FRAMES])


def name_of(number: int) -> str:
    """Return the name of a frame, such as "y -x z"."""
    rows = FRAMES[number]
    return " ".join(
        ("-" if row.sum() < 0.0 else "") + AXES[int(np.argmax(np.abs(row)))] for row in rows
    )


class QuaternionReading(NamedTuple):
    """What a quaternion's columns hold instead of (w, x, y, z) from body to world.

    Attributes:
        order: what the columns hold, or "wxyz".
        is_conjugate: whether it is from world to body.
        correct: returns right quaternions from logged ones, (num_rows, 4).
    """

    order: str
    is_conjugate: bool
    correct: Callable[[np.ndarray], np.ndarray]


HALF_TURN = Rotation.from_rotvec([np.pi, 0.0, 0.0])  # about x: between FLU and FRD, z up and NED
_ROLLS = {"wxyz": 0, "xyzw": 1, "zwxy": -1}  # places to roll the columns by


def _reading(order: str, is_conjugate: bool) -> QuaternionReading:
    signs = np.array([1.0, -1.0, -1.0, -1.0]) if is_conjugate else np.ones(4)
    return QuaternionReading(
        order, is_conjugate, lambda quat: np.roll(quat, _ROLLS[order], axis=1) * signs
    )


# The first is right. An import may have turned body or world of columns that it had read in a wrong
# order; then the other wrong order is right up to the signs of all columns.
READINGS = tuple(_reading(*how) for how in product(_ROLLS, (False, True)))
