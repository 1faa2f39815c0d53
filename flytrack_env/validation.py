"""Validate JSON and TOML files by types and limits of ``msgspec``, with one form of message.

A message names file, field, what was found and what is expected: ``a.toml: rows.every: found 0,
expected a whole number from 1``. Checks between fields are in a struct's ``__post_init__``, which
raises ValueError: ``field: found ..., expected ...``, or ``expected ...`` of the table itself.
"""

import re
import sys
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import inspect

from flytrack_env.messages import error_text, quote_name, quote_value

MAX_WHOLE_FLOAT = 2**53  # floats beyond it may not be the number that was written
MAX_NUMBER = sys.float_info.max  # integers in TOML and JSON are unbounded
Finite = Annotated[float, msgspec.Meta(ge=-MAX_NUMBER, le=MAX_NUMBER)]
Positive = Annotated[float, msgspec.Meta(gt=0.0, le=MAX_NUMBER)]
Text = Annotated[str, msgspec.Meta(min_length=1)]
BOUNDS = {"gt": "above", "ge": "from", "lt": "below", "le": "up to"}
T = TypeVar("T")


class Fields(msgspec.Struct, forbid_unknown_fields=True):
    """A table of a file; fields that it does not have are refused."""


def convert(
    where: str, values: Any, kind: type[T], error: type[Exception] = ValueError, field: str = ""
) -> T:
    """Convert the content of a JSON or TOML file to a type, strictly.

    1 is no bool, and "1" is no number. Whole floats count as integers, so that 2e7 is one.

    Args:
        where: file or object that the values are from, for messages; empty where the caller names
            it.
        values: dictionaries, lists, text and numbers.
        kind: struct, dataclass or other type; ``Annotated[..., msgspec.Meta(...)]`` sets limits.
        error: what is raised for a value that does not fit.
        field: where in the file the values are, for messages.
    """
    try:
        return msgspec.convert(_with_integers(values), kind)
    except msgspec.ValidationError as problem:
        try:
            text = _describe(str(problem), values, kind, field)
        except (
            LookupError,
            StopIteration,
            ValueError,
        ):  # a name in the file that reads like a path
            text = f"{field}: {error_text(problem)}".removeprefix(": ")
        raise error(f"{where}: {text}".removeprefix(": ")) from problem
    except RecursionError as problem:
        raise error(f"{where}: found very deeply nested values".removeprefix(": ")) from problem


def _with_integers(values: Any) -> Any:
    """Replace whole floats by integers."""
    if isinstance(values, dict):
        return {name: _with_integers(value) for name, value in values.items()}
    if isinstance(values, (list, tuple)):
        return [_with_integers(value) for value in values]
    if isinstance(values, float) and values.is_integer() and abs(values) <= MAX_WHOLE_FLOAT:
        return int(values)
    return values


def _describe(problem: str, value: Any, kind: Any, field: str) -> str:
    """Return where the problem is, what was found there and what is expected."""
    text, _, path = problem.rpartition(" - at `$") if " - at `$" in problem else (problem, "", "")
    expected = inspect.type_info(kind)
    for name, index in re.findall(r"\.(\w+)|\[(\d+)\]", path):
        if name:
            expected, value, field = _field_types(expected)[name], value[name], _join(field, name)
        else:
            expected, value, field = _item_type(expected), value[int(index)], f"{field}[{index}]"
    if missing := re.fullmatch(r"Object missing required field `(\w+)`", text):
        member = _field_types(expected)[missing[1]]
        return f"{_join(field, missing[1])}: missing, expected {describe_type(member)}"
    if re.match("Object contains unknown field", text):
        known = _field_types(expected)
        unknown = next(name for name in value if name not in known)
        return f"{_join(field, quote_name(unknown))}: unknown; expected one of {', '.join(known)}"
    if re.match("Expected|Invalid|Number out of range", text):
        return (
            f"{field}: found {quote_value(value)}, expected {describe_type(expected)}".removeprefix(
                ": "
            )
        )
    return join_text(field, text)


def join_text(field: str, text: str) -> str:
    """Put a table's name before a message on it.

    Args:
        text: ``field: found ...`` of one of its fields, or ``expected ...`` of the table itself.
    """
    if not field:
        return text
    return f"{field}: {text}" if text.startswith("expected") else f"{field}.{text}"


def choose(field: str, value: Any, choices: Iterable[str]) -> str:
    """Return a field's value; raise ValueError if it is missing or not one of the choices."""
    words = tuple(choices)
    if value not in words:
        found = "missing" if value is None else f"found {quote_value(value)}"
        raise ValueError(f"{field}: {found}, expected one of {', '.join(words)}")
    return str(value)


def check_different(field: str, values: Sequence[Any]) -> None:
    """Raise ValueError for values of a field that occur twice."""
    if len(set(values)) < len(values):
        raise ValueError(f"{field}: found {quote_value(list(values))}, expected different ones")


def _join(field: str, name: str) -> str:
    return f"{field}.{name}" if field else name


def _members(kind: inspect.Type) -> tuple[inspect.Type, ...]:
    """Return the alternatives of a type, without null."""
    if isinstance(kind, inspect.Metadata):
        return _members(kind.type)
    alternatives = kind.types if isinstance(kind, inspect.UnionType) else (kind,)
    return tuple(
        alternative for alternative in alternatives if not isinstance(alternative, inspect.NoneType)
    )


def _field_types(kind: inspect.Type) -> dict[str, inspect.Type]:
    """Return the fields of the struct that a table has to be."""
    (struct,) = (
        alternative
        for alternative in _members(kind)
        if isinstance(alternative, inspect.StructType | inspect.DataclassType)
    )
    return {field.encode_name: field.type for field in struct.fields}


def _item_type(kind: inspect.Type) -> inspect.Type:
    """Return the type of a list's items, which all have the same one."""
    for alternative in _members(kind):
        if isinstance(alternative, inspect.TupleType):
            return alternative.item_types[0]
        if isinstance(alternative, inspect.ListType | inspect.VarTupleType):
            return alternative.item_type
    raise AssertionError(f"{kind} has no items")


def describe_type(kind: inspect.Type) -> str:
    """Return the words for a type."""
    return " or ".join(map(_words, _members(kind)))


def _words(kind: inspect.Type) -> str:
    match kind:
        case inspect.FloatType() | inspect.IntType():
            limits = {word: getattr(kind, name) for name, word in BOUNDS.items()}
            stated = (f"{word} {limit:g}" for word, limit in limits.items() if _is_stated(limit))
            noun = "number" if isinstance(kind, inspect.FloatType) else "whole number"
            return " ".join([f"a {noun}", *stated])
        case inspect.StrType():
            return "a text"
        case inspect.BoolType():
            return "true or false"
        case inspect.LiteralType():
            return f"one of {', '.join(map(str, kind.values))}"
        case inspect.EnumType():
            return f"one of {', '.join(str(member.value) for member in kind.cls)}"
        case inspect.TupleType():
            item = describe_type(kind.item_types[0]).removeprefix("a ")
            plural = re.sub("number|text|list", lambda noun: f"{noun[0]}s", item, count=1)
            return f"{len(kind.item_types)} {plural}"
        case inspect.ListType() | inspect.VarTupleType():
            most = "or more" if kind.max_length is None else f"to {kind.max_length}"
            return f"a list of {kind.min_length or 0} {most}, each {describe_type(kind.item_type)}"
        case _:
            return "a table of fields"


def _is_stated(limit: float | None) -> bool:
    return (
        limit is not None and abs(limit) < 1e30
    )  # larger ones only refuse what is no finite number
