"""Reference files: a time-optimal flight of a track with a model, as data that nothing is needed to read.

A file is an ``.npz`` of numbers and one JSON text: states and commands at 100 Hz, gate times, the model
itself, and how the flight was found. It is read without unpickling.
"""

import dataclasses
import hashlib
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import BY_NAME
from flytrack_env.files import check_size, write_atomically
from flytrack_env.messages import error_text, quote_value
from flytrack_env.model_file import SIZES, model_as_json, model_from_json
from flytrack_env.npz_file import NpzError, open_npz
from flytrack_env.state import ACTION_SIZE, STATE_SIZE
from flytrack_env.tracks import Track

FOLDER = Path(__file__).parent
KINDS = ("flying", "standing")
FILE_VERSION = 1
ARRAYS = ("states", "commands", "gate_times_s")
NOTES = ("version", "track", "track_sha256", "kind", "model_name", "model_sha256", "model", "dt_s", "time_s")
TEXTS = ("track", "track_sha256", "kind", "model_name", "model_sha256")
LARGEST_BYTES = 16 * 2**20  # in the file, and unpacked: hours of flight
LONGEST_S = 3600.0  # of a lap, or of one step
BEYOND = 1e-6  # of a command beyond full stick: the solver's tolerance


class ReferenceFileError(ValueError):
    """A reference file that cannot be used; the message names file, field, what was found and expected."""


@dataclasses.dataclass(frozen=True, eq=False)
class Reference:
    """A time-optimal flight, sampled at the simulator's step.

    track, model_name: names. track_sha256: what tells the track from another of its name. kind: "flying", a
    lap from the last gate's plane to itself, periodic but for the battery; or "standing", from rest at the
    start pose through every gate once. model: what it was found with. dt_s: s. time_s: to the last gate's
    plane, s; for "flying" the lap time.
    states: (N + 1, 21) and commands: (N, 4), float64, laid out as ``flytrack_env.state`` says; each command
    is held over its step, and the last gate is passed in the last step. gate_times_s: (num_gates,), s from
    the first state. found: how it was found, JSON values (solver, status, seconds, versions, command).
    """

    track: str
    track_sha256: str
    kind: str
    model_name: str
    model: ModelParameters
    dt_s: float
    time_s: float
    states: np.ndarray
    commands: np.ndarray
    gate_times_s: np.ndarray
    found: dict[str, Any]

    def percent_above(self, time_s: float) -> float:
        """Return by how many percent a time, s, is above this one."""
        return 100.0 * (time_s / self.time_s - 1.0)


def track_digest(track: Track) -> str:
    """Return what tells a track from another, hexadecimal."""
    return hashlib.sha256(repr(track).encode()).hexdigest()


def model_digest(model: ModelParameters) -> str:
    """Return what tells a model from another, hexadecimal: of its parameters and effects, float64."""
    values = model_as_json(model)
    text = json.dumps({name: values[name] for name in ("parameters", "effects")}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def shipped_path(track: str, kind: str, model_name: str) -> Path:
    """Return where the reference of a track, kind and model lies, whether or not it is there."""
    return FOLDER / f"{track}_{model_name}_{kind}.npz"


def is_shipped(track: str, kind: str, model_name: str) -> bool:
    """Return whether there is a reference of that track, kind and model.

    A stranger's track can have any name, also that of another folder's file.
    """
    return shipped_path(track, kind, model_name) in FOLDER.glob("*.npz")


def shipped_reference(track: str, kind: str = "flying", model_name: str = "nominal") -> Reference:
    """Return a shipped reference by the names of track, kind ("flying", "standing") and model.

    Raises:
        ReferenceFileError: none of these names; the message lists those that are there.
    """
    if not is_shipped(track, kind, model_name):
        name = quote_value(shipped_path(track, kind, model_name).stem)
        names = ", ".join(sorted(found.stem for found in FOLDER.glob("*.npz"))) or "none"
        raise ReferenceFileError(f"reference: found no {name}, expected one of {names}")
    return load_reference(shipped_path(track, kind, model_name))


def save_reference(path: str | Path, reference: Reference) -> None:
    """Write a reference file, atomically; states as float32, the simulator's own precision.

    Raises:
        OSError: what the system says.
    """
    notes = {
        "version": FILE_VERSION,
        "track": reference.track,
        "track_sha256": reference.track_sha256,
        "kind": reference.kind,
        "model_name": reference.model_name,
        "model_sha256": model_digest(reference.model),
        "model": model_as_json(reference.model),
        "dt_s": reference.dt_s,
        "time_s": reference.time_s,
        "found": reference.found,
    }
    content = io.BytesIO()
    np.savez_compressed(
        content,
        allow_pickle=False,
        states=np.asarray(reference.states, np.float32),
        commands=np.asarray(reference.commands, np.float32),
        gate_times_s=np.asarray(reference.gate_times_s, float),
        notes=np.array(json.dumps(notes, allow_nan=False)),
    )
    write_atomically(Path(path), content.getvalue())


def _check_arrays(path: Path, data: dict[str, np.ndarray]) -> None:
    """Raise ReferenceFileError for arrays that are no flight."""
    num_steps = len(data["commands"]) if data["commands"].ndim else 0
    shapes = {"states": (num_steps + 1, STATE_SIZE), "commands": (num_steps, ACTION_SIZE)}
    for name, shape in shapes.items():
        if data[name].shape != shape or num_steps == 0:
            raise ReferenceFileError(f"{path}: {name}: found shape {data[name].shape}, expected {shape}")
    for name in ARRAYS:
        if data[name].dtype.kind != "f" or not np.isfinite(data[name]).all():
            raise ReferenceFileError(f"{path}: {name}: found something else, expected finite numbers")
    times_s = data["gate_times_s"]
    if times_s.ndim != 1 or times_s.size == 0 or (times_s < 0.0).any() or (np.diff(times_s) < 0.0).any():
        found = f"{times_s.shape}, {quote_value(times_s.tolist())}"
        raise ReferenceFileError(f"{path}: gate_times_s: found {found}, expected a row of growing times, s")
    most = np.abs(data["commands"]).max()
    if most > 1.0 + BEYOND:
        raise ReferenceFileError(f"{path}: commands: found {most:.7g}, expected within [-1, 1]")


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the arrays and the notes of a reference file; raises ReferenceFileError."""
    try:
        check_size(path.stat().st_size, LARGEST_BYTES)
        with open_npz(path) as archive:
            check_size(archive.num_bytes, LARGEST_BYTES)
            missing = [name for name in (*ARRAYS, "notes") if name not in archive.names]
            if missing:
                raise NpzError(f"{', '.join(missing)}: missing")
            data = {name: archive.read(name) for name in (*ARRAYS, "notes")}
        notes = json.loads(str(data.pop("notes")))
    except (OSError, ValueError, RecursionError) as error:  # ValueError: NpzError, no text, no JSON
        raise ReferenceFileError(
            f"{path}: cannot be read: {error_text(error)}; expected a reference file"
        ) from error
    missing = [name for name in (*NOTES, "found") if not isinstance(notes, dict) or name not in notes]
    if missing:
        raise ReferenceFileError(f"{path}: notes: {', '.join(missing)}: missing")
    if notes["version"] != FILE_VERSION:
        found = quote_value(notes["version"])
        raise ReferenceFileError(f"{path}: version: found {found}, expected {FILE_VERSION}")
    _check_notes(path, notes)
    return data, notes


def _check_notes(path: Path, notes: dict[str, Any]) -> None:
    """Raise ReferenceFileError for notes of other types than those written, or of no time."""
    for name in (*TEXTS, "found"):
        is_text = name in TEXTS
        if not isinstance(notes[name], str if is_text else dict):
            found, expected = quote_value(notes[name]), "a text" if is_text else "an object"
            raise ReferenceFileError(f"{path}: {name}: found {found}, expected {expected}")
    for name in ("dt_s", "time_s"):
        value = notes[name]
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not is_number or not 0.0 < value < LONGEST_S:
            found = quote_value(value)
            raise ReferenceFileError(f"{path}: {name}: found {found}, expected seconds above 0")
    if notes["kind"] not in KINDS:
        found = quote_value(notes["kind"])
        raise ReferenceFileError(f"{path}: kind: found {found}, expected one of {', '.join(KINDS)}")


def _model_of(path: Path, values: Any) -> ModelParameters:
    """Return the model of a file's JSON values, with the digits that it has; raises ReferenceFileError."""
    try:
        model_from_json(values, path)  # is each number of its kind and within its range?
        base: dict[str, Any] = {name: np.asarray(values["parameters"][name], float) for name in SIZES}
        effects = values["effects"].items()
        return ModelParameters(**base).with_effects(
            *(BY_NAME[name].parameters(**numbers) for name, numbers in effects)
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ReferenceFileError(
            f"{path}: model: cannot be read: {type(error).__name__}: {error_text(error)}"
        ) from error


def load_reference(path: str | Path) -> Reference:
    """Return the reference in a file.

    Raises:
        ReferenceFileError: missing or damaged file, pickled objects, another version, arrays that are no
            flight, commands beyond [-1, 1], notes of another type, or a model that is not the one whose
            digest is written.
    """
    path = Path(path)
    data, notes = _read(path)
    _check_arrays(path, data)
    model = _model_of(path, notes["model"])
    if model_digest(model) != notes["model_sha256"]:
        raise ReferenceFileError(f"{path}: model: found another one than its digest, expected the same")
    fields = {name: notes[name] for name in ("track", "track_sha256", "kind", "model_name", "found")}
    return Reference(
        **fields,
        model=model,
        dt_s=float(notes["dt_s"]),
        time_s=float(notes["time_s"]),
        states=data["states"].astype(float),
        commands=np.clip(data["commands"].astype(float), -1.0, 1.0),
        gate_times_s=data["gate_times_s"].astype(float),
    )
