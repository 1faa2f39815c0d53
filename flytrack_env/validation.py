"""Validating what JSON and TOML files hold, by the types and limits that msgspec reads from annotations."""

import re
from typing import Any, TypeVar

import msgspec

from flytrack_env.messages import quote_name, quote_value

T = TypeVar("T")

MAX_WHOLE_FLOAT = 2**53  # floats beyond it may not be the number that was written


def convert(where: str, values: Any, kind: type[T]) -> T:
    """Convert the content of a JSON or TOML file to a type, strictly: 1 is no bool, and "1" is no number.

    Whole floats count as integers, so that 2e7 is one.

    Args:
        where: file or object that the values are from; the message of an error begins with it.
        values: dictionaries, lists, text and numbers.
        kind: dataclass, ``msgspec.Struct`` or other type; ``Annotated[..., msgspec.Meta(...)]`` sets limits.

    Raises:
        ValueError: a value that does not fit; the message names field, value and what is expected.
    """
    try:
        return msgspec.convert(_with_integers(values), kind)
    except msgspec.ValidationError as error:
        problem, _, path = str(error).partition(" - at `$")
        field = path.strip(".`")
        text = problem.replace("`", "")
        if text.startswith("Expected") and "[...]" not in field:
            expected = text.removeprefix("Expected ").partition(", got")[0]
            text = f"found {quote_value(_look_up(values, field))}, expected {expected}"
        raise ValueError(": ".join(filter(None, (where, quote_name(field), text)))) from error


def _with_integers(values: Any) -> Any:
    """Replace whole floats by integers."""
    if isinstance(values, dict):
        return {name: _with_integers(value) for name, value in values.items()}
    if isinstance(values, (list, tuple)):
        return [_with_integers(value) for value in values]
    if isinstance(values, float) and values.is_integer() and abs(values) <= MAX_WHOLE_FLOAT:
        return int(values)
    return values


def _look_up(values: Any, field: str) -> Any:
    """Return the value of a field like ``config.hidden_sizes[0]``."""
    for index, name in re.findall(r"\[(\d+)\]|([^.\[\]]+)", field):
        values = values[int(index)] if index else values[name]
    return values
