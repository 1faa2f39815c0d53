"""Model files: the parameters of a drone as JSON, by hand or from an identification."""

import json
import warnings
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from flytrack_env import effects
from flytrack_env.battery import Battery, BatteryWarning
from flytrack_env.dynamics import ModelParameters
from flytrack_env.files import read_at_most, write_atomically
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_env.motion import Motion
from flytrack_env.validation import Fields, convert

MODEL_FILE_VERSION = 1
UNITS = {
    "tau": "s",
    "thrust_coeffs": "N, N, N, N, N/V, N/V",
    "max_rate": "deg/s",
    "m": "kg",
    "g": "m/s^2",
    "battery_drain_v_per_min": "V/min",
}
MAX_BYTES = 4 * 2**20
BATTERY = "battery"
BESIDE = ("effects", "motion", BATTERY)  # parameters, or among them


class ModelFileError(ValueError):
    """A model file that cannot be used.

    The message names file and field, what was found and what was expected.
    """


def _object(where: str, value: Any) -> dict[str, Any]:
    """Return a value that must be a JSON object; raises ModelFileError."""
    if not isinstance(value, dict):
        raise ModelFileError(f"{where}: found {quote_value(value)}, expected an object")
    return value


MAX_FLOAT32 = float(np.finfo(np.float32).max)
Number = Annotated[float, Meta(ge=-MAX_FLOAT32, le=MAX_FLOAT32)]
Above0 = Annotated[float, Meta(gt=1e-45, le=MAX_FLOAT32)]  # what is smaller is 0 in float32


class _BatteryFields(Fields):
    full_v: Number = float(Battery().full_v)
    empty_v: Number = float(Battery().empty_v)
    fitted_low_v: Number | None = None
    fitted_high_v: Number | None = None

    def battery(self) -> Battery:
        """Return the battery, by default fitted over its whole range; raises ValueError."""
        low_v = self.empty_v if self.fitted_low_v is None else self.fitted_low_v
        high_v = self.full_v if self.fitted_high_v is None else self.fitted_high_v
        battery = Battery(self.full_v, self.empty_v, low_v, high_v)
        battery.check()
        return battery


class _ModelFields(Fields):
    tau: tuple[Above0, Above0, Above0, Above0]
    thrust_coeffs: tuple[Number, Number, Number, Number, Number, Number]
    max_rate: tuple[Above0, Above0, Above0]
    m: Above0
    g: Number
    battery_drain_v_per_min: Number
    effects: dict[str, dict[str, Any]] = msgspec.field(default_factory=dict)
    motion: Motion = Motion.EULER
    battery: _BatteryFields = msgspec.field(default_factory=_BatteryFields)


def _read_effect(source: str, name: str, values: dict[str, Any]) -> Any:
    """Return the parameters of one effect; those that are not in the file are neutral."""
    field = f"effects.{name}"
    if name not in effects.BY_NAME:
        known = ", ".join(effects.BY_NAME)
        raise ModelFileError(
            f"{source}: effects.{quote_name(name)}: unknown; expected one of {known}"
        )
    effect = effects.BY_NAME[name]
    kinds: dict[str, Any] = {
        parameter: Annotated[float, Meta(ge=bounds.low, le=bounds.high)]
        for parameter, bounds in effect.ranges.items()
    }
    if effect.static:
        kinds[effect.static] = Any
    neutral = effect.parameters()._asdict()
    members = [(parameter, kind, neutral[parameter]) for parameter, kind in kinds.items()]
    fields = convert(
        source, values, msgspec.defstruct(name, members, bases=(Fields,)), ModelFileError, field
    )
    found = msgspec.structs.asdict(fields)
    if effect.static in values and effect.read is not None:
        try:
            found[effect.static] = effect.read(values[effect.static])
        except ValueError as error:
            raise ModelFileError(f"{source}: {field}.{error}") from error
    return effect.parameters(**found)


def _read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file."""
    try:
        data = json.loads(read_at_most(path, MAX_BYTES))
    except OSError as error:
        raise ModelFileError(f"{path}: cannot be read: {error_text(error)}") from error
    except (
        ValueError,
        RecursionError,
    ) as error:  # ValueError: no text, no JSON, or too many digits
        raise ModelFileError(f"{path}: not a JSON file: {error_text(error)}") from error
    return _object(str(path), data)


def load_model(path: str | Path) -> ModelParameters:
    """Return the parameters in a model file.

    The file is a JSON object with ``tau``, ``thrust_coeffs``, ``max_rate``, ``m``, ``g`` and
    ``battery_drain_v_per_min`` at the top or under ``parameters``, units as in ``ModelParameters``;
    and optionally ``effects``, an object of effects' names (``flytrack_env.effects``) with their
    parameters, ``motion``, a value of ``Motion``, without which the model moves as the handout's,
    and ``battery``, an object with the fields of ``Battery``, without which the handout's is
    assumed and a warning given.

    Raises:
        ModelFileError: missing file, not JSON, a newer version, a field missing, unknown or out of
            range.
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


def model_from_json(
    data: dict[str, Any], path: str | Path, dtype: Any = np.float32
) -> ModelParameters:
    """Return the parameters in the JSON values of a model file, or of ``model_as_json``.

    Args:
        path: where they come from, for messages.
        dtype: of the arrays.

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
    if not UNITS.keys() & values.keys():
        fields = ", ".join(map(quote_name, [*data][:4])) or "nothing"
        expected = "a model file, as `flytrack fit` and `flytrack diagnose` write it"
        raise ModelFileError(f"{path}: found other JSON ({fields}), expected {expected}")
    beside = {name: data[name] for name in BESIDE if name in data}
    content = {name: value for name, value in {**values, **beside}.items() if name != "version"}
    file = convert(str(path), content, _ModelFields, ModelFileError)
    try:
        battery = file.battery.battery()
    except ValueError as error:
        raise ModelFileError(f"{path}: {error}") from error
    base = ModelParameters(
        tau=np.array(file.tau, dtype),
        thrust_coeffs=np.array(file.thrust_coeffs, dtype),
        max_rate=np.array(file.max_rate, dtype),
        m=file.m,
        g=file.g,
        battery_drain_v_per_min=file.battery_drain_v_per_min,
        motion=file.motion,
        battery=battery,
    )
    parameters = [_read_effect(str(path), *item) for item in file.effects.items()]
    try:
        return base.with_effects(*parameters)
    except ValueError as error:
        raise ModelFileError(f"{path}: {error}") from error


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
        "parameters": {name: np.asarray(getattr(model, name), float).tolist() for name in UNITS},
        "effects": {
            name: _effect_as_json(name, parameters) for name, parameters in by_name.items()
        },
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
