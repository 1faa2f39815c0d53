"""Damage to NumPy's files: arrays of other types and shapes, headers that lie, pickles, bombs."""

import functools
import io
import struct
import warnings
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.reliability.strangers.noise import Rng, damage

Arrays = dict[str, np.ndarray]

# Unpickled, it would make a file beside it; ``pickle.find_class`` is seen before that.
PICKLE = b"cos\nsystem\n(S'touch unpickled'\ntR."
NUMBERS = (np.nan, np.inf, -np.inf, -1.0, 0.0, 1.0 + 1e-7, 2.0, 1e6, 1e30, 1e300, 0.5, 2.0**53)
TYPES = ("<i1", "<u8", "<i8", "<f2", "<f4", ">f8", "<f16", "|b1", "<c16", "|S8", "<U8", "<M8[s]", "|O")
SHAPES = (
    *("()", "(0,)", "(-1,)", "(1,)", "(True,)", "(1.0,)", "(10**9,)", "(99999999999999999999,)", "None"),
    *("(2**40, 25)", "(1099511627776, 25)", "(1099511627776,)", "(3, -25)", "(0, 99999999999)", "7", "'a'"),
    *("(" * 150 + ")" * 150, "(1,) * 9", "[3]", "(4294967296, 4294967296)", "(" + "1, " * 40 + ")"),
)
DESCRIPTIONS = (
    *(f"'{name}'" for name in TYPES),
    *("'<U99999999'", "'<U0'", "'|V0'", "'<f3'", "'f4,i4'", "[('a', '<f8')]", "[('a', '<f8', (99999,))]"),
    *(
        "('<f8', (99999999,))",
        "1",
        "'x' * 9",
        "[]",
        "None",
        "[('a', '|O')]",
        "__import__('os')",
        "'<i8' '<f8'",
    ),
)
NAMES = ("../../evil.npy", "/tmp/evil.npy", "x" * 5000, "a\nb.npy", "T.npy", "t", "t.npy/t.npy", "é.npy", "")
METHODS = (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
BOMB_BLOCK, BOMB_BLOCKS = 2**20, 3000  # zeros: 3 GB


def npy(array: np.ndarray, **changed: str) -> bytes:
    """Return an ``.npy``; changed: fields of its header, as text. Objects are the pickle above."""
    fields = {
        "descr": repr(np.lib.format.dtype_to_descr(array.dtype)),
        "fortran_order": "False",
        "shape": repr(array.shape),
        **changed,
    }
    header = "{" + ", ".join(f"'{name}': {text}" for name, text in fields.items()) + ", }\n"
    data = PICKLE if array.dtype.hasobject else array.tobytes()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header) % 2**16) + header.encode() + data


def damage_array(rng: Rng, array: np.ndarray) -> np.ndarray:
    """Return an array of other values, of another type, or of another shape."""
    way = rng.random()
    if way < 0.45 and array.dtype.kind == "f" and array.size:
        array = array.copy()
        places = rng.integers(array.size, size=int(rng.integers(1, 4)))
        array.reshape(-1)[places] = np.float64(rng.choice(NUMBERS))
        return array
    if way < 0.6:
        return _of_type(array, str(rng.choice(TYPES)))
    changes = [
        lambda: array[:-1],
        lambda: np.concatenate([array, array]) if array.ndim else array[None],
        lambda: array[:0] if array.ndim else array,
        lambda: array[..., None],
        lambda: array.reshape(-1),
        lambda: array.T,
        lambda: np.asarray(array).reshape(-1)[:1],
        lambda: array[::-1] if array.ndim else array,
        lambda: array[..., :1] if array.ndim else array,
        lambda: np.zeros_like(array),
        lambda: np.zeros((30_000, 1), np.int8),
    ]
    try:
        return changes[int(rng.integers(len(changes)))]()
    except (ValueError, IndexError):
        return array[None]


def _of_type(array: np.ndarray, name: str) -> np.ndarray:
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of imaginary parts, and of what does not fit
        try:
            return np.asarray(array).astype(name)
        except (TypeError, ValueError, OverflowError):
            return np.zeros(array.shape, name)


def damage_npy(rng: Rng, array: np.ndarray) -> bytes:
    """Return an ``.npy`` of a damaged array, or with a header that lies, or damaged anyhow."""
    if rng.random() < 0.6:
        array = damage_array(rng, array)
    changed: dict[str, str] = {}
    if rng.random() < 0.4:
        changed["shape"] = str(rng.choice(SHAPES))
    if rng.random() < 0.25:
        changed["descr"] = str(rng.choice(DESCRIPTIONS))
    if rng.random() < 0.1:
        changed["fortran_order"] = str(rng.choice(["True", "1", "None", "'yes'"]))
    if rng.random() < 0.03:
        changed[str(rng.choice(["extra", "shape'] + ['", "x" * 9000]))] = "1"
    content = npy(array, **changed)
    if rng.random() < 0.1:
        version = bytes(int(number) for number in rng.choice([0, 1, 2, 3, 9], size=2))
        content = content[:6] + version + content[8:]
    return damage(rng, [content]) if rng.random() < 0.15 else content


def zipped(members: Sequence[tuple[str, bytes]], method: int = zipfile.ZIP_STORED) -> bytes:
    """Return an archive."""
    content = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(content, "w", method) as archive:
        warnings.simplefilter("ignore")  # of names that are there twice
        for name, data in members:
            archive.writestr(zipfile.ZipInfo(name), data, method)
    return content.getvalue()


@functools.cache
def bomb() -> bytes:
    """Return the deflated zeros of a bomb, 3 MB of them; every block of them is the same bytes."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    block = bytes(BOMB_BLOCK)
    first = packer.compress(block) + packer.flush(zlib.Z_FULL_FLUSH)
    again = packer.compress(block) + packer.flush(zlib.Z_FULL_FLUSH)
    return first + again * (BOMB_BLOCKS - 1) + packer.flush()


def with_bomb(name: str, head: bytes, announced: int) -> bytes:
    """Return an archive of one member: a head and 3 GB of zeros, announced as any number of bytes."""
    stored = struct.pack("<BHH", 0, len(head), 0xFFFF ^ len(head)) + head
    data = stored + bomb()
    sizes = struct.pack("<LLL", 0, len(data), announced)
    fields = struct.pack("<HHHHH", 20, 0, zipfile.ZIP_DEFLATED, 0, 33) + sizes
    local = b"PK\x03\x04" + fields + struct.pack("<HH", len(name), 0) + name.encode() + data
    entry = b"PK\x01\x02" + struct.pack("<H", 20) + fields
    entry += struct.pack("<HHHHHLL", len(name), 0, 0, 0, 0, 0, 0) + name.encode()
    end = struct.pack("<HHHHLLH", 0, 0, 1, 1, len(entry), len(local), 0)
    return local + entry + b"PK\x05\x06" + end


def bombs(arrays: Mapping[str, np.ndarray]) -> list[bytes]:
    """Return archives that unpack to much more than they are, with the names of a valid one's arrays."""
    rows = 2**28
    found = [zipped([(f"x{number}.npy", b"") for number in range(5000)])]
    for name, array in list(arrays.items())[:2]:
        shape = repr((rows, *array.shape[1:])) if array.ndim else "()"
        head = npy(array[:0] if array.ndim else array, shape=shape)
        found += [with_bomb(f"{name}.npy", head, announced) for announced in (10_000, 2**31, 2**32 - 1)]
    zeros = {name: np.zeros((2**21, *array.shape[1:]), np.int8) for name, array in arrays.items()}
    members = [(f"{name}.npy", npy(array)) for name, array in zeros.items()]
    return [*found, zipped(members, zipfile.ZIP_DEFLATED)]


def damage_npz(rng: Rng, arrays: Mapping[str, np.ndarray], texts: Mapping[str, Any]) -> bytes:
    """Return an archive of arrays of which some are damaged, missing, new, twice, or under other names.

    texts: what takes the place of arrays that hold text: a function of rng each.
    """
    members = []
    damaged = rng.choice(list(arrays), size=int(rng.integers(1, 3)))
    for name, array in arrays.items():
        if name in texts:
            array = np.array(texts[name](rng)) if rng.random() < 0.5 else array
        is_damaged = name in damaged
        members.append((f"{name}.npy", damage_npy(rng, array) if is_damaged else npy(array)))
    if rng.random() < 0.25:
        at = int(rng.integers(len(members)))
        name, data = members[at]
        other = str(rng.choice([*NAMES, members[0][0]]))
        change = int(rng.integers(4))
        members[at : at + 1] = [[], [(name, data)] * 2, [(other, data)], [(name, data), (other, data)]][
            change
        ]
    method = int(rng.choice(METHODS)) if rng.random() < 0.3 else zipfile.ZIP_STORED
    content = zipped(members, method)
    return damage(rng, [content]) if rng.random() < 0.1 else content
