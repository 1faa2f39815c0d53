"""Checkpoints that are made to harm: msgpack that takes memory, arrays that lie, trainings that are none."""

import json
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np

from benchmarks.reliability.strangers.crafted_texts import JSON_PARTS
from benchmarks.reliability.strangers.packed import (
    ARRAY,
    hostile_checkpoints,
    packed,
    unpacked,
    with_checksum,
)
from benchmarks.reliability.strangers.trees import RAW

MANY = 50_000
EMPTY = b"\x93\x91\x00\xa4bool\xc4\x00"  # an array of nothing


def _extension(code: int, content: bytes) -> bytes:
    """Return an extension; the code of timestamps is 255."""
    return b"\xc9" + len(content).to_bytes(4, "big") + bytes([code]) + content


def _map(entries: list[tuple[bytes, bytes]]) -> bytes:
    """Return a map of packed names and values, also of such as cannot be a name."""
    return b"\xdf" + len(entries).to_bytes(4, "big") + b"".join(name + value for name, value in entries)


def _wide_and_deep(number: int, depth: int, value: bytes) -> bytes:
    """Return maps in maps, each the last of many values."""
    level = b"".join(b"\xa3%03x" % name + value for name in range(number - 1))
    return b"".join(b"\xde" + number.to_bytes(2, "big") + level + b"\xa1z" for _ in range(depth)) + b"\xc0"


def _arrays() -> list[bytes]:
    """Return extensions in place of arrays: lists in lists, shapes and types that lie."""
    forms: tuple[tuple[Any, Any, Any], ...] = (
        ([2**62, 0], b"float32", b""),
        ([2**63 - 1] * 4, b"float32", b""),
        ([1] * 32, b"float32", bytes(4)),
        ([4], b"object", bytes(32)),
        ([4], b"int4", bytes(4)),
        ([4], b"float8_e5m2", bytes(4)),
        ([4], b"complex128", bytes(64)),
        ([4], b"datetime64", bytes(32)),
        ([4], b"void", bytes(4)),
        ([2], "float32", bytes(8)),
        ([2], b"float32", "\0" * 8),
        ([2.0], b"float32", bytes(8)),
        (2, b"float32", bytes(8)),
    )
    inner = [msgpack.packb(form) for form in forms]
    lists = b"\x90"
    for _ in range(5):
        lists = b"\x9f" + lists * 15
    inner += [
        b"\x93" + lists + b"\xa0\xa0",
        b"\x93" + b"\x91" * 400 + b"\xc0",
        b"\x93" + (b"\xdc\x00\x20" + b"\x90" * 31) * 400 + b"\x90",
    ]
    inner += [b"", b"\x93", b"\x93\xdd\xff\xff\xff\xff", b"\x93\x91\x01\xc6\xff\xff\xff\xff", b"\xc1"]
    return [_extension(ARRAY, one) for one in inner]


def _values() -> list[bytes]:
    """Return values that are no array, text or number."""
    stamps = [
        _extension(code, content) for code in (255, 2, 3, 127) for content in (b"", bytes(4), b"\xff" * 12)
    ]
    nested = [_extension(ARRAY, _extension(ARRAY, _extension(ARRAY, b""))), b"\x81\xa1a" * 500 + b"\xc0"]
    texts = [b"\xdb\x00\x10\x00\x00" + b"a" * (2**20 - 4) + "\U0001f681".encode(), b"\xa4\xff\xff\xff\xff"]
    numbers = [b"\xcf" + b"\xff" * 8, b"\xcb\x7f\xf8" + bytes(6), b"\xca\x7f\x80\x00\x00"]
    nested += [_wide_and_deep(251, 500, b"\xc0"), _wide_and_deep(2000, 900, b"\xc0")]
    nested.append(_wide_and_deep(2000, 300, msgpack.packb(msgpack.ExtType(ARRAY, EMPTY))))
    wide = msgpack.packb("a" * 2**20 + "\U0001f681")
    texts.append(_map([(msgpack.packb(str(name)), wide) for name in range(24)]))
    return [*stamps, *nested, *texts, *numbers, *_arrays()]


def _names() -> list[bytes]:
    """Return names that are none, packed."""
    return [
        b"\x01",
        b"\xc0",
        b"\xc4\x01a",
        b"\xa1\x00",
        b"\x80",
        b"\xcb\x7f\xf8" + bytes(6),
        b"\xda\xff\xff" + b"x" * 65_535,
    ]


def _descriptions(meta: dict[str, Any]) -> list[str]:
    """Return descriptions that are hard to read, or of networks and settings that are none."""
    config = meta["config"]
    changes: list[dict[str, Any]] = [
        {**meta, "config": {**config, "hidden_sizes": [2**16] * 62}},
        {**meta, "config": {**config, "hidden_sizes": [1] * MANY}},
        {**meta, "config": {**config, "initial_action": [0.0] * MANY}},
        {**meta, "config": {**config, "total_timesteps": 10**308}},
        {**meta, "config": {f"x{number}": 1 for number in range(MANY)}},
        {**meta, "observation_size": 2**16},
        {**meta, "observation_size": 2**63},
        {**meta, "track": "../../../../dev/zero.toml"},
        {**meta, "track": "a\0b"},
        {**meta, "steps": 2**62},
        {**meta, "steps": 10**300},
        {**meta, "seconds": 1e308},
        {**meta, "seen": {str(number): 0.5 for number in range(MANY)}},
        {**meta, "environment": {f"x{number}": number for number in range(3 * MANY)}},
        {**meta, "model": {f"x{number}": [] for number in range(3 * MANY)}},
        {**meta, "observation": {f"row {number}": {"x": [[]]} for number in range(MANY)}},
    ]
    texts = [json.dumps(one) for one in changes]
    holes = [json.dumps({**meta, name: "@here@"}) for name in ("config", "seed", "model", "seen")]
    parts = [*JSON_PARTS, *RAW.values()]
    return [*texts, *parts, *(hole.replace('"@here@"', part) for hole in holes for part in parts)]


def _contents(parts: dict[str, Any]) -> list[bytes]:
    """Return what is under a checksum."""
    packer: Callable[[Any], bytes] = packed
    known = [(msgpack.packb(name), packer(value)) for name, value in parts.items()]
    found = [packer({**parts, "meta": text}) for text in _descriptions(json.loads(parts["meta"]))]
    for name in (b"params", b"training", b"meta"):
        rest = [one for one in known if one[0] != msgpack.packb(name.decode())]
        key = msgpack.packb(name.decode())
        found += [_map([*rest, (key, value)]) for value in _values()]
        found += [_map([*rest, (key, _map([(b"\xa1a", value)]))]) for value in _values()]
    found += [_map([*known, (name, b"\xc0")]) for name in _names()]
    found += [_map([*known, *known]), _map([*known, *((b"\xa1a", b"\xc0") for _ in range(MANY))])]
    return found


def hostile_policies(contents: list[bytes]) -> list[bytes]:
    """Return checkpoints that are made to harm, with their checksums and without."""
    inner = _contents(unpacked(contents[0]))
    checksums = [msgpack.packb({"checksum": found, "content": b""}) for found in ("x" * 2**20, b"", 7, None)]
    texts = [msgpack.packb({"checksum": "0" * 64, "content": "x" * 2**20})]
    return [*hostile_checkpoints(), *map(with_checksum, inner), *inner[:50], *checksums, *texts]


def hostile_trainings(contents: list[bytes]) -> list[bytes]:
    """Return trainings that are made to harm: as ``hostile_policies``, and of other arrays."""
    parts = unpacked(contents[0])
    training = parts["training"]
    leaves = [name for name, leaf in training.items() if isinstance(leaf, tuple)]
    changed = []
    for name in leaves:
        shape, kind, values = training[name]
        other = np.zeros(shape, kind.decode())
        changed += [
            {**training, name: ([*shape, 1], kind, values)},
            {**training, name: (shape, b"float16", np.zeros(shape, np.float16).tobytes())},
            {**training, name: (shape, kind, b"\xff" * len(values))},
            {**training, name: ([2**40], kind, values)},
            {one: leaf for one, leaf in training.items() if one != name},
            {**training, name: {"a": (list(other.shape), kind, values)}},
        ]
    changed += [training | {f"x{number}": ([0], b"int8", b"") for number in range(MANY)}, {}]
    found = [with_checksum(packed({**parts, "training": one})) for one in changed]
    return [*hostile_policies(contents), *found]
