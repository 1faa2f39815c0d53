"""Messages about the content of files."""

from typing import Annotated, Literal

import pytest
from msgspec import Meta

from flytrack_env.validation import Fields, Finite, Positive, Text, check_different, convert


class Inner(Fields):
    low: Finite = 0.0
    high: Positive | None = None
    names: Annotated[tuple[Text, ...], Meta(min_length=1, max_length=2)] = ("one",)
    place: tuple[Finite, Finite] = (0.0, 0.0)
    kind: Literal["b", "a"] = "a"
    count: Annotated[int, Meta(ge=1, le=9)] = 1
    is_on: bool = False

    def __post_init__(self):
        check_different("names", self.names)
        if self.high is not None and self.high <= self.low:
            raise ValueError("expected low below high")


class Outer(Fields):
    inner: Inner
    others: tuple[Inner, ...] = ()


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (3, "a.toml: found 3, expected a table of fields"),
        ({}, "a.toml: inner: missing, expected a table of fields"),
        ({"inner": {}, "outer": 1}, "a.toml: outer: unknown; expected one of inner, others"),
        (
            {"inner": {"lo\n": 1}},
            "a.toml: inner.'lo\\n': unknown; expected one of low, high, names, ",
        ),
        ({"inner": {"low": "x"}}, "a.toml: inner.low: found 'x', expected a number"),
        ({"inner": {"low": float("nan")}}, "a.toml: inner.low: found nan, expected a number"),
        ({"inner": {"low": 10**400}}, "a.toml: inner.low: found 1000"),
        ({"inner": {"low": True}}, "a.toml: inner.low: found True, expected a number"),
        ({"inner": {"high": 0}}, "a.toml: inner.high: found 0, expected a number above 0"),
        ({"inner": {"high": 1, "low": 2}}, "a.toml: inner: expected low below high"),
        (
            {"inner": {"names": []}},
            "a.toml: inner.names: found [], expected a list of 1 to 2, each a text",
        ),
        (
            {"inner": {"names": ["a", "a"]}},
            "a.toml: inner.names: found ['a', 'a'], expected different ones",
        ),
        ({"inner": {"place": [1.0]}}, "a.toml: inner.place: found [1.0], expected 2 numbers"),
        ({"inner": {"kind": "c"}}, "a.toml: inner.kind: found 'c', expected one of a, b"),
        (
            {"inner": {"count": 10}},
            "a.toml: inner.count: found 10, expected a whole number from 1 up to 9",
        ),
        ({"inner": {"is_on": 1}}, "a.toml: inner.is_on: found 1, expected true or false"),
        (
            {"inner": {}, "others": [{}, {"low": ""}]},
            "a.toml: others[1].low: found '', expected a number",
        ),
        ({"inner": {}, " - at `$.inner": 1}, "a.toml: "),
        ({"inner": {}, " - at `$.other": 1}, "a.toml: "),
    ],
)
def test_messages_name_file_field_found_and_expected(value, message):
    with pytest.raises(ValueError) as error:
        convert("a.toml", value, Outer)
    assert str(error.value).startswith(message) and str(error.value).isprintable()
