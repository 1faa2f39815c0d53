"""Damage to checkpoints: what is under the checksum, and the maps and arrays around it."""

import hashlib
import json
from typing import Any

import msgpack
import numpy as np

from benchmarks.reliability.strangers.archives import damage_array
from benchmarks.reliability.strangers.noise import Rng, damage
from benchmarks.reliability.strangers.trees import ODD, as_json, damage_tree

ARRAY = 1  # flax's number of arrays among msgpack's extensions
SHAPES: tuple[Any, ...] = (
    *([], [0], [-1], [2**40], [2**62, 4], [1.5], ["a"], 7, None, [1] * 40, [3, -25], [0, 2**62], [True]),
)
TYPES = (b"float64", b"int8", b"object", b"O", b"bfloat16", b"", b"\xff", b"U8", b"f4,i4", b"x" * 999)


def unpacked(content: bytes) -> dict[str, Any]:
    """Return the parts of a checkpoint that is well: a tree whose arrays are (shape, type, bytes)."""
    whole = msgpack.unpackb(content, raw=False)
    return msgpack.unpackb(whole["content"], raw=False, ext_hook=_parts_of)


def _parts_of(code: int, data: bytes) -> tuple[Any, bytes, bytes]:
    shape, name, values = msgpack.unpackb(data, raw=True)
    return shape, name, values


def packed(parts: Any) -> bytes:
    """Return parts as bytes; arrays are (shape, type, bytes)."""
    return msgpack.packb(_with_arrays(parts), strict_types=True)


def _with_arrays(part: Any) -> Any:
    if isinstance(part, tuple):
        return msgpack.ExtType(ARRAY, msgpack.packb(part))
    if isinstance(part, dict):
        return {name: _with_arrays(value) for name, value in part.items()}
    return part


def with_checksum(content: bytes) -> bytes:
    """Return a checkpoint of any content, with the checksum that belongs to it."""
    return msgpack.packb({"checksum": hashlib.sha256(content).hexdigest(), "content": content})


def _damage_leaf(rng: Rng, leaf: Any) -> Any:
    """Return something else in place of an array."""
    way = rng.random()
    if not isinstance(leaf, tuple) or way < 0.1:
        odd = ODD[int(rng.integers(len(ODD)))]
        return odd if _can_be_packed(odd) else None
    shape, name, content = leaf
    if way < 0.5:
        try:
            array = np.frombuffer(content, name.decode()).reshape(shape)
        except (TypeError, ValueError):  # it is damaged already
            return leaf
        found = damage_array(rng, array)
        return list(found.shape), found.dtype.name.encode(), b"" if found.dtype.hasobject else found.tobytes()
    if way < 0.7:
        return SHAPES[int(rng.integers(len(SHAPES)))], name, content
    if way < 0.85:
        return shape, TYPES[int(rng.integers(len(TYPES)))], content
    return shape, name, content[: int(rng.integers(len(content) + 1))]


def _can_be_packed(value: Any) -> bool:
    try:
        msgpack.packb(value)
    except (OverflowError, ValueError, UnicodeEncodeError):
        return False
    return True


def _leaves(part: dict[str, Any]) -> list[tuple[dict[str, Any], str]]:
    """Return what holds each leaf of a tree, and its name there."""
    found = []
    for name, value in part.items():
        found += _leaves(value) if isinstance(value, dict) else [(part, name)]
    return found


def _damage_parts(rng: Rng, parts: dict[str, Any]) -> bytes:
    """Return parts as bytes, of which the description or an array is damaged."""
    if rng.random() < 0.5:
        meta = json.loads(parts["meta"])
        text = as_json(rng, damage_tree(rng, meta)).decode(errors="replace")
        return packed({**parts, "meta": text[:10_000] if rng.random() < 0.02 else text})
    for _ in range(int(rng.integers(1, 4))):
        leaves = _leaves(parts)
        if not leaves:
            break
        holder, name = leaves[int(rng.integers(len(leaves)))]
        way = rng.random()
        if way < 0.8:
            holder[name] = _damage_leaf(rng, holder[name])
        elif way < 0.9:
            del holder[name]
        else:
            holder[["x", "../x", "", "x" * 5000, "a.b"][int(rng.integers(5))]] = holder[name]
    return packed(parts)


def damage_checkpoint(rng: Rng, contents: list[bytes]) -> bytes:
    """Return one of some checkpoints, damaged beneath its checksum, or at all."""
    content = contents[int(rng.integers(len(contents)))]
    way = rng.random()
    if way < 0.8:
        inner = _damage_parts(rng, unpacked(content))
        # The first format had no checksum.
        return with_checksum(inner) if rng.random() < 0.9 else inner
    inner = msgpack.unpackb(content, raw=False)["content"]
    return with_checksum(damage(rng, [inner]))


def hostile_checkpoints() -> list[bytes]:
    """Return small files that take a lot of memory or of stack where nothing bounds them."""
    empty_maps = b"\x80"
    named_maps = b"".join(b"\xa8" + f"{number:08d}".encode() + empty_maps for number in range(60_000))
    names = [f"{number:08d}" for number in range(150_000)]
    inner = [
        b"\xdd" + (2**24).to_bytes(4, "big") + empty_maps * 2**24,  # a list of empty maps
        b"\xdf" + (60_000).to_bytes(4, "big") + named_maps,
        b"\x81\xa1a" * 5000 + b"\xc0",  # maps in maps
        b"\x91" * 5000 + b"\xc0",  # lists in lists
        msgpack.packb({name: {} for name in names}),
        msgpack.packb({"meta": "[" + "{}," * 2**22 + "{}]"}),
        msgpack.packb({"meta": '{"format": "flytrack-ppo-2", "config": ' + '{"a":' * 50_000}),
        b"\xc6\xff\xff\xff\xff",  # announces 4 GiB
        b"\xdf\xff\xff\xff\xff",
        msgpack.packb({"x": msgpack.ExtType(2, b"\x92\x01\x02")}),
        msgpack.packb({"x": msgpack.ExtType(ARRAY, b"\xdd\xff\xff\xff\xff")}),
    ]
    return [*inner, *map(with_checksum, inner)]
