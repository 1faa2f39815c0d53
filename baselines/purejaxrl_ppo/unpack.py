"""Reading msgpack as flax writes it, with bounds on what it may hold: numbers, texts, arrays in named trees.

A map of a few bytes takes fifty times as much in memory, and flax asks for no bound.
"""

import re
from collections.abc import Iterable
from typing import Any

import jax.numpy as jnp
import msgpack
import numpy as np

from flytrack_env.messages import error_text

LARGEST_BYTES = 3 * 2**27  # of a file: a little more than twice that in memory, below 1 GiB
MOST_ENTRIES = 100_000  # of all maps together
MOST_IN_MAP = 2000  # of one, which is made room for before it is counted, as are all that it lies in
MOST_ARRAYS = 10_000  # each of which calls Python, and is read before the map that it stands in is counted
LONGEST_NAME = 200  # bytes
MOST_DIMENSIONS = 32
ARRAY = 1  # flax's number of arrays among msgpack's extensions
DTYPE = re.compile(r"[a-z]+[0-9]*")


class UnpackError(ValueError):
    """Bytes that flax did not write, or more than one of ours writes; the message does not name the file."""


class _Maps:
    """Makes maps of their entries, and counts them."""

    def __init__(self) -> None:
        self._num_entries = 0

    def __call__(self, entries: Iterable[tuple[Any, Any]]) -> dict[str, Any]:
        pairs = list(entries)  # a list, or where msgpack is not compiled, a generator
        self._num_entries += len(pairs)
        if self._num_entries > MOST_ENTRIES:
            raise UnpackError(f"found more than {MOST_ENTRIES} entries, expected at most that")
        found = ((_name_of(name), value) for name, value in pairs)
        named = {name: value for name, value in found if name is not None}
        if len(named) < len(pairs):
            raise UnpackError(f"found names that are not {len(pairs)} different short texts")
        return named


class _Lists:
    """Lets through the lists of an array: its shape, and what the shape stands in."""

    def __init__(self) -> None:
        self._number = 0

    def __call__(self, values: list[Any]) -> list[Any]:
        self._number += 1
        if self._number > 2:
            raise UnpackError("found lists in lists, expected an array's shape, type and bytes")
        return values


class _Arrays:
    """Makes arrays of extensions, and counts them."""

    def __init__(self) -> None:
        self._number = 0

    def __call__(self, code: int, data: bytes) -> np.ndarray:
        self._number += 1
        if self._number > MOST_ARRAYS:
            raise UnpackError(f"found more than {MOST_ARRAYS} arrays, expected at most that")
        return _array(code, data)


def _name_of(value: Any) -> str | None:
    """Return the name of an entry; None where it is none."""
    is_short = isinstance(value, bytes) and len(value) <= LONGEST_NAME
    return name if is_short and (name := value.decode()).isprintable() else None


def _array(code: int, data: bytes) -> np.ndarray:
    """Return an array: packed are its shape, the name of its type, and its bytes."""
    if code != ARRAY:
        raise UnpackError(f"found an extension {code}, expected arrays")
    shape, name, content = msgpack.unpackb(
        data, raw=True, max_array_len=MOST_DIMENSIONS, max_map_len=0, list_hook=_Lists()
    )
    if not DTYPE.fullmatch(text := name.decode()):
        raise UnpackError("found an array of an unknown type, expected numbers")
    dtype = jnp.dtype(text)
    if not (jnp.issubdtype(dtype, np.number) or dtype == np.bool_):
        raise UnpackError(f"found an array of {dtype}, expected numbers")
    if not all(type(size) is int and size >= 0 for size in shape):
        raise UnpackError("found an array of a shape that is none")
    return np.frombuffer(content, dtype).reshape(shape)


def unpack(content: bytes) -> Any:
    """Return what bytes hold: maps with names, bytes, numbers, arrays; no lists.

    Texts stay bytes: one wide character would make all of a text four times as large.

    Raises:
        UnpackError: damaged, or something else, or more than a checkpoint has.
    """
    try:
        return msgpack.unpackb(
            content,
            raw=True,
            max_array_len=0,
            max_map_len=MOST_IN_MAP,
            ext_hook=_Arrays(),
            object_pairs_hook=_Maps(),
        )
    except UnpackError:
        raise
    except Exception as error:  # msgpack raises what it likes on damaged bytes
        raise UnpackError(f"{type(error).__name__}: {error_text(error)}") from error
