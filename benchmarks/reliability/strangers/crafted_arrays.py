"""Archives and arrays of NumPy that are made to harm: what their bytes announce is not what they hold."""

import json
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.reliability.strangers.archives import Arrays, bombs, npy, zipped
from benchmarks.reliability.strangers.crafted_texts import jsons

LOCAL, ENTRY, END = b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06"
ENCRYPTED, DESCRIBED_BEHIND = 1, 8  # bits of an entry's flags
LARGE_FIELD = struct.pack("<HH", 1, 24) + struct.pack("<QQQ", 2**63, 2**63, 2**62)  # of zip64
ZEROS = bytes(2**25)


def archive(members: Sequence[tuple[str, bytes]], **changed: int | bytes) -> bytes:
    """Return an archive; changed: what all entries say: flags, method, crc, size, packed_size, extra, offset.

    ``local_flags`` is what stands before the data alone.
    """
    parts, entries, at = [], [], 0
    for name, data in members:
        flags, local_flags = int(changed.get("flags", 0)), int(changed.get("local_flags", 0))
        extra = bytes(changed.get("extra", b""))  # type: ignore[arg-type]  # of what is bytes
        size, packed_size = (int(changed.get(one, len(data))) for one in ("size", "packed_size"))
        crc = int(changed.get("crc", zlib.crc32(data)))
        method = int(changed.get("method", 0))
        sums = struct.pack("<HHHLLL", method, 0, 33, crc, packed_size, size)
        lengths = struct.pack("<HH", len(name.encode()), len(extra))
        local = LOCAL + struct.pack("<HH", 20, flags | local_flags) + sums + lengths + name.encode() + extra
        offset = int(changed.get("offset", at))
        entry = ENTRY + struct.pack("<HHH", 20, 20, flags) + sums + lengths
        entries.append(entry + struct.pack("<HHHLL", 0, 0, 0, 0, offset) + name.encode() + extra)
        parts += [local, data]
        at += len(local) + len(data)
    listed = b"".join(entries)
    end = END + struct.pack("<HHHHLLH", 0, 0, len(entries), len(entries), len(listed), at, 0)
    return b"".join([*parts, listed, end])


def _members(arrays: Mapping[str, np.ndarray], **changed: str) -> list[tuple[str, bytes]]:
    return [(f"{name}.npy", npy(array, **changed)) for name, array in arrays.items()]


def archives_that_lie(arrays: Arrays) -> list[bytes]:
    """Return archives with a well one's arrays, of which the entries are not true."""
    members = _members(arrays)
    whole, (name, data) = archive(members), members[0]
    commented = whole[:-2] + struct.pack("<H", 2**16 - 1) + b"PK\x05\x06" * 2**14
    return [
        archive(members, flags=ENCRYPTED),
        archive(members, local_flags=ENCRYPTED),
        archive(members, flags=DESCRIBED_BEHIND, size=0, packed_size=0, crc=0),
        archive(members, local_flags=DESCRIBED_BEHIND, packed_size=2**32 - 1),
        archive(members, offset=0),  # all are the first
        archive(members, offset=2**32 - 2),
        archive([(name, whole), *members[1:]]),  # an archive in place of an array
        archive(members, extra=LARGE_FIELD, size=2**32 - 1, packed_size=2**32 - 1, offset=2**32 - 1),
        archive(members, extra=b"\x01\x00\xff\xff"),
        archive(members, extra=b"\xff" * 2**15),
        archive(members, method=99),
        archive(members, size=2**31),
        archive(members, packed_size=2**31),
        archive([*members, *members]),
        archive([(name, data)] * 700),
        archive([(f"../../{name}", data) for name, data in members]),
        archive([(f"/etc/{name}", data) for name, data in members]),
        archive([(f"{name}/", data) for name, data in members]),
        archive([(name + "\0", data) for name, data in members]),
        commented[: len(whole) + 2**16 - 1],
        whole[:-2] + b"\xff\xff",
        whole * 3,
    ]


def packed_otherwise(arrays: Arrays) -> list[bytes]:
    """Return archives of zeros, packed in ways of which zipfile bounds no unpacking."""
    name, array = next(iter(arrays.items()))
    zeros = npy(array[:0] if array.ndim else array, shape=f"({2**25},)", descr="'|i1'") + ZEROS
    rest = [one for one in _members(arrays) if one[0] != f"{name}.npy"]
    return [
        zipped([(f"{name}.npy", zeros), *rest], method) for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
    ]


def _nested(depth: int) -> str:
    return "[('a', " * depth + "'<f8'" + ")]" * depth


HEADS: tuple[dict[str, str], ...] = (
    *(
        {"descr": text}
        for text in (_nested(20), _nested(90), _nested(3000), "'|O'", "[('a', '|O')]", "'|V8'")
    ),
    *({"descr": text} for text in ("'<f8'" + " " * 60_000, "'<U" + "9" * 4000 + "'", "'<m8[ns]'", "'|S0'")),
    {"descr": "[" + ", ".join(f"('x{number}', '<f8')" for number in range(3000)) + "]"},
    {"descr": "[" + ", ".join(f"('x{number}', '<f8', ({number + 1},))" for number in range(999)) + "]"},
    {"descr": "[('a', '<f8', (2147483647,)), ('b', '<f8', (2147483647,))]"},
    {"descr": "[('a', '<f8', (65536, 65536, 65536, 65536))]"},
    *({"shape": text} for text in ("(-1,)", "(2**62,)", f"({2**62}, 4)", f"({2**63}, 0)", "(0, 1)" * 9)),
    *({"shape": text} for text in (f"({2**64}, 0, {2**64})", "(" + "0, " * 70 + ")", "(" + "1, " * 70 + ")")),
    *({"shape": text} for text in ("-" * 9000 + "1", "[" * 9000, "(" + "9" * 5000 + ",)", "{1: 2}", "b'x'")),
    {"fortran_order": "True"},
    {"fortran_order": "-" * 20_000 + "1"},
)


def arrays_that_lie(arrays: Arrays) -> list[bytes]:
    """Return archives of which one array's head says more than there is, or is hard to read."""
    name, array = list(arrays.items())[-1]
    rest = [one for one in _members(arrays) if one[0] != f"{name}.npy"]
    return [archive([*rest, (f"{name}.npy", data)]) for data in npy_that_lie(array)]


def npy_that_lie(array: np.ndarray) -> list[bytes]:
    """Return ``.npy`` files whose head says more than there is, or is hard to read."""
    well = npy(array)
    lengths = [well[:8] + struct.pack("<H", length) + well[10:] for length in (0, 1, 2**16 - 1)]
    second = [
        b"\x93NUMPY\x02\x00" + struct.pack("<I", length) + well[10:] for length in (0, 2**31, 2**32 - 1)
    ]
    return [*(npy(array, **head) for head in HEADS), *lengths, *second, well[:6] + b"\x03\x00" + well[8:]]


def on_purpose(arrays: Arrays) -> list[bytes]:
    """Return archives with a well one's arrays that are made to harm in any of these ways."""
    return [*bombs(arrays), *archives_that_lie(arrays), *packed_otherwise(arrays), *arrays_that_lie(arrays)]


def _steps(num_rows: int, step: float, **more: np.ndarray) -> dict[str, np.ndarray]:
    columns = {f"u_{axis}": np.zeros(num_rows) for axis in ("roll", "pitch", "yaw", "thrust")}
    return {"t": step * np.arange(num_rows), **columns, **more}


def hostile_rollouts(rows: np.ndarray) -> list[bytes]:
    """Return rollouts of values, shapes and types that are hard to take; and of more than there is."""
    huge = rows.astype(float)
    huge[0, 0] = 1e300
    wide = rows.astype(np.longdouble)
    return [
        *npy_that_lie(rows),
        npy(huge),
        npy(wide),
        npy(rows.astype(np.int64) * 0 + 2**62),
        npy(np.asfortranarray(rows), fortran_order="True"),
        npy(np.zeros((2**21 + 1, rows.shape[1]), np.int8)),
        npy(rows[:0]),
        npy(rows, shape=f"({2**21}, {rows.shape[1]})"),
    ]


def hostile_logs(arrays: Arrays) -> list[bytes]:
    """Return logs as ``on_purpose`` does, of a segment for every row, and of odd steps of time."""
    many = 100_001
    columns = [
        _steps(many, 0.01, segment=np.arange(many)),
        _steps(200, 1e300),
        _steps(200, 5e-324),
        _steps(500, 86_400.0),
        _steps(9, 0.01, segment=2.0**53 * np.arange(9)),
        {**_steps(9, 0.01), **{f"q_{axis}": np.zeros(9) for axis in "wxyz"}},
        {**_steps(9, 0.01), **{f"q_{axis}": np.full(9, 1e200) for axis in "wxyz"}},
        {**_steps(9, 0.01), **{f"v_{axis}": np.full(9, 1e300) for axis in "xyz"}},
    ]
    return [*on_purpose(arrays), *(archive(_members(one)) for one in columns)]


def hostile_scripts(arrays: Arrays) -> list[bytes]:
    """Return scripts as ``on_purpose`` does, and of very many names, which are more as Python has them."""
    names = [np.full(2**22, "\U0001f681a"), np.zeros(2**22, "<U1"), np.full((2**11, 2**11), "a")]
    lists = [{**arrays, "kinds": one} for one in names]
    return [*on_purpose(arrays), *(zipped(_members(one), zipfile.ZIP_DEFLATED) for one in lists)]


def hostile_references(arrays: Arrays) -> list[bytes]:
    """Return references as ``on_purpose`` does, and of notes that are hard to read."""
    notes = json.loads(str(arrays["notes"]))
    texts = jsons(notes, ("found", "model", "track", "time_s"))
    odd = [np.full(2**20, "a"), np.array("[" * 2**21), arrays["states"], np.array(b"{}")]
    found = [*map(np.array, texts), *odd]
    return [*on_purpose(arrays), *(archive(_members({**arrays, "notes": one})) for one in found)]
