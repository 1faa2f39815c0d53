"""Reading tables of a TOML file: every field checked, every refusal with file, field, found and expected."""

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_env.toml_file import TomlError, parse_toml, read_text
from flytrack_sysid.log import LogError

LARGEST_COUNT = 2**53
LARGEST = sys.float_info.max  # whole numbers in TOML know no bound
REQUIRED: Any = object()  # a default that says there is none


def read_toml(path: Path) -> dict[str, Any]:
    """Return what a TOML file holds.

    Raises:
        LogError: a file that cannot be read or is not TOML.
    """
    try:
        return parse_toml(read_text(path))
    except (OSError, UnicodeDecodeError, TomlError) as error:
        raise LogError(f"{path}: not a readable TOML file: {error_text(error)}") from error


class Fields:
    """One table of a file, from which fields are taken by name; what is left over at the end is refused."""

    def __init__(self, source: str, name: str, table: Any):
        self.source, self.name = source, name
        if not isinstance(table, dict):
            raise self.error("", f"found {quote_value(table)}, expected a table")
        self.left, self.known = dict(table), list[str]()

    def error(self, field: str, text: str) -> LogError:
        """Return the error about one field, or about the table itself."""
        where = ".".join(part for part in (self.name, field) if part)
        return LogError(f"{self.source}: {where}: {text}")

    def __contains__(self, field: str) -> bool:
        return field in self.left

    def _take(self, field: str, default: Any, expected: str) -> Any:
        self.known.append(field)
        if field not in self.left and default is REQUIRED:
            raise self.error(field, f"missing, expected {expected}")
        return self.left.pop(field, default)

    def _refuse(self, field: str, value: Any, expected: str) -> LogError:
        return self.error(field, f"found {quote_value(value)}, expected {expected}")

    def table(self, field: str) -> "Fields | None":
        """Return a table of the table, None if it is not there."""
        value = self._take(field, None, "a table")
        name = f"{self.name}.{field}" if self.name else field
        return None if value is None else Fields(self.source, name, value)

    def text(self, field: str, default: Any = REQUIRED) -> Any:
        """Return a text that is not empty."""
        value = self._take(field, default, "a text")
        if value is not default and not (isinstance(value, str) and value):
            raise self._refuse(field, value, "a text")
        return value

    def choice(self, field: str, choices: Sequence[str], default: Any = REQUIRED) -> Any:
        """Return one of some words."""
        value = self._take(field, default, " or ".join(choices))
        if value is not default and value not in choices:
            raise self._refuse(field, value, f"one of {', '.join(choices)}")
        return value

    def flag(self, field: str) -> bool:
        """Return true or false, false if the field is not there."""
        value = self._take(field, False, "true or false")
        if not isinstance(value, bool):
            raise self._refuse(field, value, "true or false")
        return value

    def number(self, field: str, default: Any = REQUIRED, above: float = -math.inf) -> Any:
        """Return a finite number above a bound."""
        bound = f" above {above:g}" if math.isfinite(above) else ""
        value = self._take(field, default, f"a number{bound}")
        if value is not default and not (_is_number(value) and value > above):
            raise self._refuse(field, value, f"a number{bound}")
        return value if value is default else float(value)

    def count(self, field: str, default: Any, least: int) -> Any:
        """Return a whole number that is at least a bound."""
        value = self._take(field, default, "a whole number")
        is_whole = isinstance(value, int) and not isinstance(value, bool)
        if value is not default and not (is_whole and least <= value < LARGEST_COUNT):
            raise self._refuse(field, value, f"a whole number of at least {least}, below 2^53")
        return value

    def numbers(self, field: str, size: int, default: Any = REQUIRED, above: float = -math.inf) -> Any:
        """Return a tuple of some finite numbers above a bound."""
        bound = f" above {above:g}" if math.isfinite(above) else ""
        value = self._take(field, default, f"{size} numbers")
        if value is default:
            return value
        is_right = isinstance(value, list) and len(value) == size
        if not is_right or not all(_is_number(one) and one > above for one in value):
            raise self._refuse(field, value, f"{size} numbers{bound}")
        return tuple(float(one) for one in value)

    def names(self, field: str, size: int) -> tuple[str, ...]:
        """Return a tuple of some texts, no two the same."""
        value = self._take(field, REQUIRED, f"{size} names of columns")
        is_right = isinstance(value, list) and all(isinstance(one, str) and one for one in value)
        if not is_right or len(value) != size or len(set(value)) != size:
            raise self._refuse(field, value, f"{size} different names of columns")
        return tuple(value)

    def done(self) -> None:
        """Refuse fields that nothing has asked for."""
        for field in self.left:
            raise self.error(quote_name(field), f"unknown; expected of {', '.join(self.known) or 'nothing'}")


def _is_number(value: Any) -> bool:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_number and -LARGEST < value < LARGEST  # false for NaN too
