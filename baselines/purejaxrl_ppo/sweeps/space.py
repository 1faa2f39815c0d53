"""The search space of a sweep: a TOML file that defines, for each setting, how Ray Tune draws its values."""

from pathlib import Path
from typing import Any

from ray import tune

from baselines.purejaxrl_ppo.config import FIELD_TYPES, ConfigError, load_toml, read_value
from flytrack_env.messages import error_text, quote_name, quote_value

LISTS = ("choice", "grid_search")  # of values; the others are ranges of numbers
KINDS = (*LISTS, "uniform", "quniform", "loguniform", "qloguniform", "randint", "lograndint")


def read_space(path: Path) -> dict[str, Any]:
    """Return how Ray Tune draws the fields of ``Config`` that a file names, one kind per field.

    A file has tables such as ``[learning_rate]`` with ``loguniform = [1e-3, 1e-2]``.

    Raises:
        ConfigError: a file, field, kind or value that cannot be used.
    """
    space = {}
    for name, entry in load_toml(path).items():
        where = f"{path}: {quote_name(name)}"
        if name not in FIELD_TYPES:
            raise ConfigError(f"{where}: unknown; expected one of {', '.join(FIELD_TYPES)}")
        if not isinstance(entry, dict) or len(entry) != 1 or next(iter(entry)) not in KINDS:
            raise ConfigError(f"{where}: found {quote_value(entry)}, expected one of {', '.join(KINDS)}")
        ((kind, values),) = entry.items()
        try:
            values = [read_value(where, FIELD_TYPES[name], value) for value in values]
            space[name] = getattr(tune, kind)(*([values] if kind in LISTS else values))
        except TypeError as error:
            raise ConfigError(f"{where}: {kind}: found {quote_value(values)}: {error_text(error)}") from error
    if not space:
        raise ConfigError(f"{path}: found no setting, expected at least one of {', '.join(FIELD_TYPES)}")
    return space
