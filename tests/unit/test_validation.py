"""Messages about the content of files."""

from typing import Annotated, Literal

import pytest
from msgspec import Meta

from flytrack_env.validation import Fields, Finite, Positive, Text, check_different, convert
from tests.support.tables import table


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
    table("messages")["refused"],
)
def test_messages_name_file_field_found_and_expected(value, message):
    with pytest.raises(ValueError) as error:
        convert("a.toml", value, Outer)
    assert str(error.value).startswith(message) and str(error.value).isprintable()
