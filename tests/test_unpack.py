"""Checkpoints that would take far more memory than they are long: refused before they do."""

import tracemalloc

import msgpack
import pytest

from baselines.purejaxrl_ppo.unpack import LONGEST_TEXT, MOST_IN_MAP, UnpackError, unpack

ARRAY = b"\xc9%s\x01"  # an extension: how long, and that it is an array


def _deep_maps() -> bytes:
    """Return maps in maps, each the last value of one of many names."""
    level = b"".join(b"\xa3%03x\xc0" % number for number in range(3000))
    return b"".join(b"\xde" + (3001).to_bytes(2, "big") + level + b"\xa1z" for _ in range(500)) + b"\xc0"


def _deep_lists() -> bytes:
    """Return an array whose shape is a tree of lists, fifteen in each."""
    tree = b"\x90"
    for _ in range(5):
        tree = b"\x9f" + tree * 15
    inner = b"\x93" + tree + b"\xa0\xa0"
    return b"\x81\xa1a" + ARRAY % len(inner).to_bytes(4, "big") + inner


def _many_in_a_map() -> bytes:
    return b"\xdf\x00\x0f\x00\x00" + b"".join(b"\xa5%05x\xc0" % number for number in range(15 * 2**16))


@pytest.mark.parametrize(
    "content",
    [
        msgpack.packb({"meta": "a" * (LONGEST_TEXT - 3) + "\U0001f681"}),
        _deep_maps(),
        _deep_lists(),
        _many_in_a_map(),
    ],
    ids=["wide text", "maps in maps", "lists in lists", "a large map"],
)
def test_what_is_made_to_take_memory_is_refused_first(content: bytes) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(UnpackError):
            unpack(content)
        assert tracemalloc.get_traced_memory()[1] < 2**23
    finally:
        tracemalloc.stop()


def test_as_many_as_may_be_are_read() -> None:
    found = unpack(msgpack.packb({str(number): number for number in range(MOST_IN_MAP)}))
    assert len(found) == MOST_IN_MAP
    text = "\U0001f681" * (LONGEST_TEXT // 4)
    assert unpack(msgpack.packb({"meta": text})) == {"meta": text}
