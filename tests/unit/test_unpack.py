"""Checkpoints that would take far more memory than they are long: refused before they do."""

import tracemalloc

import msgpack
import pytest
from baselines.purejaxrl_ppo.unpack import MOST_ARRAYS, MOST_IN_MAP, UnpackError, unpack

EMPTY = b"\xc7\n\x01\x93\x91\x00\xa4bool\xc4\x00"  # an array of nothing
ARRAY = b"\xc9%s\x01"  # an extension: how long, and that it is an array


def _deep_maps(value: bytes, depth: int) -> bytes:
    """Return maps in maps, each the last value of one of many names, beside others."""
    level = b"".join(b"\xa3%03x" % number + value for number in range(MOST_IN_MAP - 1))
    head = b"\xde" + MOST_IN_MAP.to_bytes(2, "big")
    return b"".join(head + level + b"\xa1z" for _ in range(depth)) + b"\xc0"


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
    ("content", "most_bytes"),
    [
        (_deep_maps(b"\xc0", 900), 2**28),  # as deep as msgpack goes
        (_deep_maps(EMPTY, 900), 2**23),
        (_deep_lists(), 2**23),
        (_many_in_a_map(), 2**23),
    ],
    ids=["maps in maps", "arrays in maps in maps", "lists in lists", "a large map"],
)
def test_what_is_made_to_take_memory_is_refused_first(content: bytes, most_bytes: int) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(UnpackError):
            unpack(content)
        assert tracemalloc.get_traced_memory()[1] < most_bytes
    finally:
        tracemalloc.stop()


def test_as_many_as_may_be_are_read() -> None:
    found = unpack(msgpack.packb({str(number): number for number in range(MOST_IN_MAP)}))
    assert len(found) == MOST_IN_MAP
    found = unpack(_deep_maps(EMPTY, MOST_ARRAYS // MOST_IN_MAP))
    assert found["000"].shape == (0,) and found["z"]["z"]["001"].dtype == bool


def test_wide_texts_take_no_more_than_they_are_long() -> None:
    text = ("a" * 2**20 + "\U0001f681").encode()
    content = msgpack.packb({str(number): text.decode() for number in range(20)})
    tracemalloc.start()
    try:
        assert unpack(content) == {str(number): text for number in range(20)}
        assert tracemalloc.get_traced_memory()[1] < 1.5 * len(content)
    finally:
        tracemalloc.stop()
