"""A corrected mapping file, by what a check found.

Only fields that the changes concern are written anew, in place; the other lines of the file stay.
"""

import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from flytrack_env.motors import NAMES
from flytrack_env.toml_file import parse_toml
from flytrack_sysid.check.explain import Change
from flytrack_sysid.check.frames import FRAMES, name_of
from flytrack_sysid.check.words import describe
from flytrack_sysid.importing.units import UNITS
from flytrack_sysid.log import LogError

TABLES = {"p": "position", "v": "velocity", "f": "specific_force", "w": "rates", "v_bat": "battery"}
DIMENSIONS = {"p": "length", "v": "speed", "f": "acceleration", "w": "rate", "v_bat": "voltage"}
OPPOSITE = {
    "flu": "frd",
    "frd": "flu",
    "z_up": "ned",
    "ned": "z_up",
}
ORDERS = ("wxyz", "xyzw")
TURNED = ("frd", "ned")  # half a turn about x from ours
HALF_TURN = np.diag([1.0, -1.0, -1.0])
HALF_TURN_NAME = "x -y -z"
OTHER_DIRECTION = {"body_to_world": "world_to_body", "world_to_body": "body_to_world"}
UNIT_TOLERANCE = 0.01  # relative
COMMENT = re.compile(r"\s+#[^\"'\]]*$")  # behind a value; one with quotes may be a part of it
Fields = dict[str, Any]


class Fix(NamedTuple):
    """A corrected mapping.

    Attributes:
        text: of the TOML file.
        fixed: changes that it corrects.
        left: changes that a mapping cannot correct.
    """

    text: str
    fixed: tuple[Change, ...]
    left: tuple[Change, ...]


def fix_mapping(text: str, changes: Sequence[Change]) -> Fix:
    """Return a mapping that reads a log as a check says it should be read.

    Args:
        text: of the mapping file, TOML.
        changes: one explanation of a check.

    Raises:
        LogError: the text is no mapping whose lines can be replaced.
    """
    fixed, left = [], []
    for change in changes:
        tables = parse_toml(text)
        found = _corrections(tables, change)
        if not found:
            left.append(change)
            continue
        for table, fields in found.items():
            for field, value in fields.items():
                text = _with_field(text, table, field, value)
        fixed.append(change)
    return Fix(text, tuple(fixed), tuple(left))


def _corrections(tables: Fields, change: Change) -> dict[str, Fields]:
    """Return the fields that correct a change, by table; None removes one. Empty: it cannot be."""
    channel, kind, value = change
    if channel == "q" and "attitude" in tables:
        fields = _attitude(tables["attitude"], kind, value)
        return {"attitude": fields} if fields else {}
    if channel == "u_rates" and kind == "axes" and "command" in tables:
        return {"command": _sticks(tables["command"], FRAMES[_number(str(value))])}
    if channel == "u_thrust" and "command" in tables:
        fields = _thrust(tables["command"], kind, value)
        return {"command": fields} if fields else {}
    if channel == "motors" and len(tables.get("motors", {}).get("columns", ())) == len(NAMES):
        held = [int(number) - 1 for number in str(value).split()]
        columns = tables["motors"]["columns"]
        return {"motors": {"columns": [columns[held.index(motor)] for motor in range(len(NAMES))]}}
    table = TABLES.get(channel, "")
    if table not in tables:
        return {}
    if kind == "axes":
        return {table: _vector(tables[table], str(value))}
    if kind == "scale":
        return {table: _unit(tables[table], DIMENSIONS[channel], float(value))}
    return {}


def _number(name: str) -> int:
    return next(number for number in range(len(FRAMES)) if name_of(number) == name)


def _attitude(fields: Fields, kind: str, value: Any) -> Fields:
    """Return corrected fields of the table ``attitude``; empty if none can correct it."""
    if kind == "order" and "quaternion" in fields:
        return _order(fields, str(value))
    if kind == "conjugate":
        direction = fields.get("direction", "body_to_world")
        return {"direction": OTHER_DIRECTION[direction]}
    if kind in ("body", "world") and value == HALF_TURN_NAME:
        return {kind: OPPOSITE[fields[kind]]}
    return {}


def _order(fields: Fields, held: str) -> Fields:
    """Return corrected fields of a quaternion's columns; ``held`` by those read as w, x, y, z."""
    order = fields["order"]
    right = "".join(held["wxyz".index(letter)] for letter in order)
    if right in ORDERS:
        return {"order": right}
    return {"quaternion": [fields["quaternion"][right.index(letter)] for letter in order]}


def _vector(fields: Fields, name: str) -> Fields:
    """Return corrected fields of a table of a vector."""
    if name == HALF_TURN_NAME:
        return {"frame": OPPOSITE[fields["frame"]]}
    turned = HALF_TURN if fields["frame"] in TURNED else np.eye(3)
    signs = np.diag(fields.get("signs", [1.0, 1.0, 1.0]))
    # As read: turned @ signs @ columns. Right: frame.T of that, with the same word for the frame.
    right = turned @ FRAMES[_number(name)].T @ turned @ signs
    order = np.argmax(np.abs(right), axis=1)
    return {
        "columns": [fields["columns"][column] for column in order],
        "signs": [int(sign) for sign in right.sum(axis=1)],
    }


def _unit(fields: Fields, dimension: str, factor: float) -> Fields:
    """Return corrected fields of a unit: its name, or its size."""
    size = fields["scale"] if "scale" in fields else UNITS[dimension][fields["unit"]]
    right = size / factor
    for name, per_unit in UNITS[dimension].items():
        if abs(right / per_unit - 1.0) < UNIT_TOLERANCE:
            return {"unit": name, "scale": None}
    return {"scale": float(f"{right:.6g}"), "unit": None}


def _ends(fields: Fields) -> tuple[list[float], ...]:
    """Return the values of a file that mean -1, and those that mean 1."""
    return tuple(list(fields.get(name, [end] * 4)) for name, end in (("low", -1.0), ("high", 1.0)))


def _sticks(fields: Fields, frame: np.ndarray) -> Fields:
    """Return corrected fields of the rate commands."""
    low, high = _ends(fields)
    order = [*np.argmax(np.abs(frame.T), axis=1), 3]
    signs = [*frame.T.sum(axis=1), 1.0]
    ends = [
        (low[column], high[column]) if sign > 0 else (high[column], low[column])
        for column, sign in zip(order, signs, strict=True)
    ]
    return {
        "columns": [fields["columns"][column] for column in order],
        "low": [first for first, _ in ends],
        "high": [last for _, last in ends],
    }


def _thrust(fields: Fields, kind: str, value: Any) -> Fields:
    """Return corrected fields of the thrust command."""
    low, high = _ends(fields)

    def as_logged(number: float) -> float:
        """Return the file's value that was read as a number."""
        return float(low[3] + 0.5 * (number + 1.0) * (high[3] - low[3]))

    if kind == "axes":
        ends = high[3], low[3]
    elif kind == "range":
        first, last = (1000.0, 2000.0) if value == "pwm" else (0.0, 1.0)
        ends = as_logged(first), as_logged(last)
    else:
        return {}
    return {"low": [*low[:3], ends[0]], "high": [*high[:3], ends[1]]}


def _with_field(text: str, table: str, field: str, value: Any) -> str:
    """Return a TOML text with a field of a table replaced, added, or removed if it is None."""
    lines = text.splitlines()
    heading = re.compile(rf"\s*\[\s*{table}\s*\]\s*(#.*)?$")
    start = next((number for number, line in enumerate(lines) if heading.match(line)), None)
    if start is None:
        raise LogError(f"{table}: expected a line [{table}], to replace {field} below it")
    end = next(
        (number for number in range(start + 1, len(lines)) if re.match(r"\s*\[", lines[number])),
        len(lines),
    )
    is_field: Callable[[str], Any] = re.compile(rf"\s*{field}\s*=").match
    place = next((number for number in range(start + 1, end) if is_field(lines[number])), None)
    line = [] if value is None else [f"{field} = {msgspec.json.encode(value).decode()}"]
    if place is not None:
        comment = COMMENT.search(lines[place])
        if comment is not None:
            line = [f"{text}{comment.group()}" for text in line]
        lines[place : place + 1] = line
    else:
        lines[start + 1 : start + 1] = line
    result = "\n".join(lines) + "\n"
    if parse_toml(result)[table].get(field) != value:
        raise LogError(f"{table}.{field}: found several lines, expected one to replace")
    return result


def text_of_fix(fix: Fix) -> str:
    """Return what a corrected mapping corrects, and what it cannot."""
    lines = [f"corrected: {describe(change)}" for change in fix.fixed]
    lines += [f"left, for a mapping cannot say it: {describe(change)}" for change in fix.left]
    return "\n".join(lines)
