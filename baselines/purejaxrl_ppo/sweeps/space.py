"""The search space of a sweep: a TOML file that defines, for each setting, how Ray Tune draws its values."""

import inspect
import typing
from pathlib import Path
from typing import Any

from ray import tune

from baselines.purejaxrl_ppo.config import FIELD_TYPES, ConfigError, load_toml, read_value
from flytrack_env.messages import quote_name, quote_value

LISTS = ("choice", "grid_search")  # of values; the others are ranges of numbers
KINDS = (*LISTS, "uniform", "quniform", "loguniform", "qloguniform", "randint", "lograndint")

Space = dict[str, dict[str, list[Any]]]


def read_space(path: Path) -> Space:
    """Return a file's settings: ``{field of Config: {kind: values}}``, one kind per field.

    A file has tables such as ``[learning_rate]`` with ``loguniform = [1e-3, 1e-2]``.

    Raises:
        ConfigError: a file, field, kind or value that cannot be used.
    """
    space = load_toml(path)
    if not space:
        raise ConfigError(f"{path}: found no setting, expected at least one of {', '.join(FIELD_TYPES)}")
    for name, entry in space.items():
        if name not in FIELD_TYPES:
            raise ConfigError(
                f"{path}: {quote_name(name)}: unknown; expected one of {', '.join(FIELD_TYPES)}"
            )
        if not isinstance(entry, dict) or len(entry) != 1 or next(iter(entry)) not in KINDS:
            raise ConfigError(
                f"{path}: {name}: found {quote_value(entry)}, expected one of {', '.join(KINDS)}"
            )
        (kind, values) = next(iter(entry.items()))
        entry[kind] = _read_values(f"{path}: {name}", name, kind, values)
    return space


def _read_values(where: str, name: str, kind: str, values: Any) -> list[Any]:
    """Return the values of a kind, of the field's type."""
    if not isinstance(values, list) or not values:
        raise ConfigError(f"{where}: {kind}: found {quote_value(values)}, expected a list of values")
    if kind in LISTS:
        return [read_value(where, FIELD_TYPES[name], value) for value in values]
    if typing.get_origin(FIELD_TYPES[name]) is tuple or FIELD_TYPES[name] is bool:
        raise ConfigError(f"{where}: found {kind}, expected one of {', '.join(LISTS)}: it is not a number")
    arguments = list(inspect.signature(getattr(tune, kind)).parameters)
    number = 3 if "q" in arguments and kind.startswith("q") else 2
    if len(values) != number:
        raise ConfigError(
            f"{where}: {kind}: found {quote_value(values)}, expected {', '.join(arguments[:number])}"
        )
    numbers = [read_value(where, FIELD_TYPES[name], value) for value in values]
    if not numbers[0] < numbers[1]:
        raise ConfigError(f"{where}: {kind}: found {numbers}, expected the smaller one first")
    return numbers


def for_tune(space: Space) -> dict[str, Any]:
    """Return the space as Ray Tune takes it."""
    parts = {}
    for name, entry in space.items():
        (kind, values) = next(iter(entry.items()))
        make = getattr(tune, kind)
        parts[name] = make(values) if kind in LISTS else make(*values)
    return parts
