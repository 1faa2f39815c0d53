"""Model files: the parameters of a drone as JSON, by hand or from an identification."""

import json
import reprlib
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.files import write_atomically

MODEL_FILE_VERSION = 1
SIZES = {
    "tau": 4,
    "thrust_coeffs": 6,
    "max_rate": 3,
    "m": 0,
    "g": 0,
    "battery_drain_v_per_min": 0,
    "linear_drag": 3,
}
MAY_BE_ABSENT = ("linear_drag",)
UNITS = {
    "tau": "s",
    "thrust_coeffs": "N, N, N, N, N/V, N/V",
    "max_rate": "deg/s",
    "m": "kg",
    "g": "m/s^2",
    "battery_drain_v_per_min": "V/min",
    "linear_drag": "1/s",
}
LARGEST = float(np.finfo(np.float32).max)
MUST_BE_POSITIVE = ("tau", "max_rate", "m")


class ModelFileError(ValueError):
    """A model file that cannot be used; the message names file, field, what was found and expected."""


def _read_field(path: Path, name: str, value: Any) -> Any:
    size = SIZES[name]
    values = value if isinstance(value, list) else [value]
    is_right_shape = isinstance(value, list) == (size > 0) and len(values) == max(size, 1)
    are_numbers = all(
        isinstance(v, (int, float)) and not isinstance(v, bool) and -LARGEST < v < LARGEST for v in values
    )
    if not is_right_shape or not are_numbers:
        expected = f"{size} finite numbers" if size else "a finite number"
        found = reprlib.repr(value)
        raise ModelFileError(f"{path}: {name}: found {found}, expected {expected} (float32)")
    if name in MUST_BE_POSITIVE and min(values) <= 0.0:
        raise ModelFileError(f"{path}: {name}: found {value!r}, expected > 0")
    return np.array(value, np.float32) if size else float(value)


def load_model(path: str | Path) -> ModelParameters:
    """Return the parameters in a model file.

    The file is a JSON object with ``tau``, ``thrust_coeffs``, ``max_rate``, ``m``, ``g``,
    ``battery_drain_v_per_min`` and perhaps ``linear_drag``, at the top or under ``parameters``; units as
    in ``ModelParameters``.

    Raises:
        ModelFileError: missing file, not JSON, a newer version, a field missing, unknown or out of range.
    """
    path = Path(path)
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ModelFileError(f"{path}: cannot be read: {error}") from error
    except (ValueError, RecursionError) as error:  # ValueError also for endless digits
        raise ModelFileError(f"{path}: not a JSON file: {error}") from error
    if not isinstance(data, dict):
        raise ModelFileError(f"{path}: found a {type(data).__name__}, expected an object")
    version = data.get("version", MODEL_FILE_VERSION)
    if version != MODEL_FILE_VERSION:
        raise ModelFileError(f"{path}: version: found {version!r}, expected {MODEL_FILE_VERSION}")
    values = data.get("parameters", data)
    if not isinstance(values, dict):
        raise ModelFileError(f"{path}: parameters: found {values!r}, expected an object")
    for name in SIZES:
        if name not in values and name not in MAY_BE_ABSENT:
            raise ModelFileError(f"{path}: {name}: missing")
    for name in set(values) - set(SIZES) - {"version"}:
        raise ModelFileError(f"{path}: {name}: unknown; expected {', '.join(SIZES)}")
    return ModelParameters(
        **{name: _read_field(path, name, values[name]) for name in SIZES if name in values}
    )


def save_model(path: str | Path, model: ModelParameters, provenance: dict[str, Any]) -> None:
    """Write a model file; ``provenance`` (JSON values) says how the parameters came about.

    Written to a temporary name beside the target and renamed, so that no half-written file is left.
    """
    path = Path(path)
    parameters = {name: np.asarray(getattr(model, name), float).tolist() for name in SIZES}
    document = {
        "version": MODEL_FILE_VERSION,
        "parameters": parameters,
        "units": UNITS,
        "provenance": provenance,
    }
    write_atomically(path, (json.dumps(document, indent=2) + "\n").encode())
