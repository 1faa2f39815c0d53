"""Model files: the parameters of a drone as JSON, by hand or from an identification."""

import json
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_env import effects
from flytrack_env.battery import Battery, BatteryWarning
from flytrack_env.dynamics import ModelParameters
from flytrack_env.files import read_at_most, write_atomically
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_env.motion import Motion

MODEL_FILE_VERSION = 1
SIZES = {"tau": 4, "thrust_coeffs": 6, "max_rate": 3, "m": 0, "g": 0, "battery_drain_v_per_min": 0}
UNITS = {
    "tau": "s",
    "thrust_coeffs": "N, N, N, N, N/V, N/V",
    "max_rate": "deg/s",
    "m": "kg",
    "g": "m/s^2",
    "battery_drain_v_per_min": "V/min",
}
LARGEST_BYTES = 4 * 2**20
LARGEST = float(np.finfo(np.float32).max)
BATTERY = "battery"
MUST_BE_POSITIVE = ("tau", "max_rate", "m")


class ModelFileError(ValueError):
    """A model file that cannot be used; the message names file, field, what was found and expected."""


def _is_number(value: Any, low: float = -LARGEST, high: float = LARGEST) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and low <= value <= high


def _object(where: str, value: Any) -> dict[str, Any]:
    """Return a value that must be a JSON object; raises ModelFileError."""
    if not isinstance(value, dict):
        raise ModelFileError(f"{where}: found {quote_value(value)}, expected an object")
    return value


def _known(where: str, name: str, names: Iterable[str]) -> str:
    """Return a name that must be one of some; raises ModelFileError."""
    if name not in names:
        raise ModelFileError(f"{where}: {quote_name(name)}: unknown; expected one of {', '.join(names)}")
    return name


def _read_field(path: Path, name: str, value: Any, dtype: Any) -> Any:
    size = SIZES[name]
    values = value if isinstance(value, list) else [value]
    is_right_shape = isinstance(value, list) == (size > 0) and len(values) == max(size, 1)
    if not is_right_shape or not all(map(_is_number, values)):
        expected = f"{size} finite numbers" if size else "a finite number"
        raise ModelFileError(f"{path}: {name}: found {quote_value(value)}, expected {expected} (float32)")
    if name in MUST_BE_POSITIVE and min(map(np.float32, values)) <= 0.0:  # 1e-50 is 0 in float32
        raise ModelFileError(f"{path}: {name}: found {quote_value(value)}, expected > 0")
    return np.array(value, dtype) if size else float(value)


def _read_effect(path: Path, name: str, values: Any) -> Any:
    """Return the parameters of one effect; those that are not in the file are neutral."""
    if name == "learned_residual":
        raise ModelFileError(
            f"{path}: effects: learned_residual: networks are no longer part of a model, expected other "
            "effects only; diagnose the log again"
        )
    effect = effects.BY_NAME[_known(f"{path}: effects", name, effects.BY_NAME)]
    where, static = f"{path}: effects: {name}", {}
    values = dict(_object(where, values))
    if effect.static and effect.static in values and effect.read is not None:
        try:
            static[effect.static] = effect.read(values.pop(effect.static))
        except ValueError as error:
            raise ModelFileError(f"{where}: {error}") from error
    for field, value in values.items():
        bounds = effect.ranges[_known(where, field, effect.ranges)]
        if not _is_number(value, bounds.low, bounds.high):
            expected = f"{bounds.low:g} to {bounds.high:g} {bounds.unit}"
            raise ModelFileError(f"{where}: {field}: found {quote_value(value)}, expected {expected}")
    return effect.parameters(**{field: float(value) for field, value in values.items()}, **static)


def _read_battery(path: Path, value: Any) -> Battery:
    """Return a battery; voltages that are not in the file are the handout's, or those of the battery."""
    where = f"{path}: {BATTERY}"
    values = _object(where, value)
    for name, volts in values.items():
        _known(where, name, Battery._fields)
        if not _is_number(volts):
            raise ModelFileError(f"{where}: {name}: found {quote_value(volts)}, expected a voltage")
    battery = Battery(**{name: float(volts) for name, volts in values.items()})
    battery = battery._replace(
        fitted_low_v=values.get("fitted_low_v", battery.empty_v),
        fitted_high_v=values.get("fitted_high_v", battery.full_v),
    )
    try:
        battery.check()
    except ValueError as error:
        raise ModelFileError(f"{path}: {error}") from error
    return battery


def _read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file."""
    try:
        data = json.loads(read_at_most(path, LARGEST_BYTES))
    except OSError as error:
        raise ModelFileError(f"{path}: cannot be read: {error_text(error)}") from error
    except (ValueError, RecursionError) as error:  # ValueError: no text, no JSON, or too many digits
        raise ModelFileError(f"{path}: not a JSON file: {error_text(error)}") from error
    return _object(str(path), data)


def load_model(path: str | Path) -> ModelParameters:
    """Return the parameters in a model file.

    The file is a JSON object with ``tau``, ``thrust_coeffs``, ``max_rate``, ``m``, ``g`` and
    ``battery_drain_v_per_min`` at the top or under ``parameters``, units as in ``ModelParameters``; and
    optionally ``effects``, an object of effects' names (``flytrack_env.effects``) with their parameters,
    ``motion``, a value of ``Motion``, without which the model moves as the handout's, and ``battery``, an
    object with the fields of ``Battery``, without which the handout's is assumed and a warning given.

    Raises:
        ModelFileError: missing file, not JSON, a newer version, a field missing, unknown or out of range.
    """
    data = _read_json(Path(path))
    model = model_from_json(data, path)
    if BATTERY not in data and BATTERY not in data.get("parameters", {}):
        text = (
            f"{path}: battery: missing, as in files of older versions; flown at the handout's "
            f"{model.battery.describe()}"
        )
        warnings.warn(BatteryWarning(text), stacklevel=2)
    return model


def model_from_json(data: dict[str, Any], path: str | Path, dtype: Any = np.float32) -> ModelParameters:
    """Return the parameters in the JSON values of a model file, or of ``model_as_json``.

    path: where they come from, for messages. dtype: of the arrays.

    Raises:
        ModelFileError: a newer version, a field missing, unknown or out of range.
    """
    path = Path(path)
    version = data.get("version", MODEL_FILE_VERSION)
    if version != MODEL_FILE_VERSION:
        is_newer = isinstance(version, int) and version > MODEL_FILE_VERSION
        why = "; written by a newer FlyTrack, update to read it" if is_newer else ""
        raise ModelFileError(
            f"{path}: version: found {quote_value(version)}, expected {MODEL_FILE_VERSION}{why}"
        )
    values = _object(f"{path}: parameters", data.get("parameters", data))
    if not SIZES.keys() & values.keys():
        fields = ", ".join(map(quote_name, [*data][:4])) or "nothing"
        expected = "a model file, as `flytrack fit` and `flytrack diagnose` write it"
        raise ModelFileError(f"{path}: found other JSON ({fields}), expected {expected}")
    for name in SIZES:
        if name not in values:
            raise ModelFileError(f"{path}: {name}: missing")
    for name in values:
        _known(str(path), name, (*SIZES, "effects", "motion", BATTERY, "version"))
    by_name = _object(f"{path}: effects", data.get("effects", values.get("effects", {})))
    motion = data.get("motion", values.get("motion", Motion.HANDOUT.value))
    motion = Motion(_known(f"{path}: motion", motion, [one.value for one in Motion]))
    read = {name: _read_field(path, name, values[name], dtype) for name in SIZES}
    battery = _read_battery(path, data.get(BATTERY, values.get(BATTERY, {})))
    base = ModelParameters(**read, motion=motion, battery=battery)
    return base.with_effects(*(_read_effect(path, name, by_name[name]) for name in by_name))


def load_provenance(path: str | Path) -> dict[str, Any]:
    """Return a model file's record of how its parameters came about; empty if it has none.

    Raises:
        ModelFileError: missing file, not JSON, or a provenance that is no object.
    """
    return _object(f"{path}: provenance", _read_json(Path(path)).get("provenance", {}))


def model_as_json(model: ModelParameters) -> dict[str, Any]:
    """Return a model as JSON values: parameters, effects, units, motion and battery."""
    by_name = {effects.effect_of(parameters).name: parameters for parameters in model.effects}
    effect_units = {
        name: {field: bounds.unit for field, bounds in effects.BY_NAME[name].ranges.items()}
        for name in by_name
    }
    return {
        "parameters": {name: np.asarray(getattr(model, name), float).tolist() for name in SIZES},
        "effects": {name: _effect_as_json(name, parameters) for name, parameters in by_name.items()},
        "units": {**UNITS, **effect_units},
        "motion": model.motion.value,
        BATTERY: {name: float(volts) for name, volts in model.battery._asdict().items()},
    }


def _effect_as_json(name: str, parameters: Any) -> dict[str, Any]:
    effect = effects.BY_NAME[name]
    values: dict[str, Any] = {field: float(getattr(parameters, field)) for field in effect.ranges}
    if effect.written is not None:
        values[effect.static] = effect.written(getattr(parameters, effect.static))
    return values


def save_model(path: str | Path, model: ModelParameters, provenance: dict[str, Any]) -> None:
    """Write a model file; ``provenance`` (JSON values) says how the parameters came about.

    Written under a temporary name and renamed, so no half-written file is left.
    """
    document = {"version": MODEL_FILE_VERSION, **model_as_json(model), "provenance": provenance}
    write_atomically(Path(path), (json.dumps(document, indent=2, allow_nan=False) + "\n").encode())
