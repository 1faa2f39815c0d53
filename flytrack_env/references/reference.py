"""Time-optimal flights of a track with a model: their files, and the ghost to fly beside another flight.

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
from flytrack_env.files import write_atomically
from flytrack_env.messages import error_text, quote_value
from flytrack_env.model_file import SIZES, model_as_json, model_from_json
from flytrack_env.npz_file import NpzError, load_npz
from flytrack_env.state import ACTION_SIZE, STATE_SIZE
from flytrack_env.tracks import Track

FOLDER = Path(__file__).parent
KINDS = ("flying", "standing")
FILE_VERSION = 1
ARRAYS = ("states", "commands", "gate_times_s")
TEXTS = ("track", "track_sha256", "kind", "model_name", "model_sha256")
NOTES = ("version", *TEXTS, "model", "dt_s", "time_s", "found")
LARGEST_BYTES = 16 * 2**20  # in the file, and unpacked: hours of flight
LONGEST_S = 3600.0  # of a lap, or of one step
BEYOND = 1e-6  # of a command beyond full stick: the solver's tolerance


class ReferenceFileError(ValueError):
    """A reference file that cannot be used; the message names file, field, what was found and expected."""


@dataclasses.dataclass(frozen=True, eq=False)
class Reference:
    """A time-optimal flight, sampled at the simulator's step.

    track, model_name: names. track_sha256: digest of the track. kind: "flying", a lap from the last gate's
    plane to itself, periodic except for the battery; or "standing", from rest at the start pose through
    every gate once. model: that it is optimal for. dt_s: s. time_s: to the last gate's plane, s; for "flying"
    the lap time.
    states: (N + 1, 21) and commands: (N, 4), float64, laid out as in ``flytrack_env.state``; each command
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


References = dict[str, Reference]  # by kind


def track_digest(track: Track) -> str:
    """Return the digest of a track, hexadecimal."""
    return hashlib.sha256(repr(track).encode()).hexdigest()


def model_digest(model: ModelParameters) -> str:
    """Return the digest of a model's parameters and effects, float64, hexadecimal."""
    values = model_as_json(model)
    text = json.dumps({name: values[name] for name in ("parameters", "effects")}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def shipped_path(track: str, kind: str, model_name: str) -> Path:
    """Return the path of the reference of a track, kind and model, whether or not it exists."""
    return FOLDER / f"{track}_{model_name}_{kind}.npz"


def is_shipped(track: str, kind: str, model_name: str) -> bool:
    """Return whether a reference of that track, kind and model is shipped."""
    # A track of one's own may have any name, even one that leads to another folder.
    return shipped_path(track, kind, model_name) in FOLDER.glob("*.npz")


def shipped_reference(track: str, kind: str = "flying", model_name: str = "nominal") -> Reference:
    """Return a shipped reference by the names of track, kind ("flying", "standing") and model.

    Raises:
        ReferenceFileError: none of these names; the message lists those that exist.
    """
    if not is_shipped(track, kind, model_name):
        name = quote_value(shipped_path(track, kind, model_name).stem)
        names = ", ".join(sorted(found.stem for found in FOLDER.glob("*.npz"))) or "none"
        raise ReferenceFileError(f"reference: found no {name}, expected one of {names}")
    return load_reference(shipped_path(track, kind, model_name))


def save_reference(path: str | Path, reference: Reference) -> None:
    """Write a reference file, atomically; states as float32, the simulator's own precision.

    Raises:
        OSError: the file cannot be written.
    """
    copied = ("track", "track_sha256", "kind", "model_name", "dt_s", "time_s", "found")
    notes = {
        "version": FILE_VERSION,
        **{name: getattr(reference, name) for name in copied},
        "model_sha256": model_digest(reference.model),
        "model": model_as_json(reference.model),
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
    """Raise ReferenceFileError for wrong shapes, numbers that are not finite, or commands beyond [-1, 1]."""
    num_steps = len(data["commands"]) if data["commands"].ndim else 0
    shapes = {"states": (num_steps + 1, STATE_SIZE), "commands": (num_steps, ACTION_SIZE)}
    for name, shape in shapes.items():
        if data[name].shape != shape or num_steps == 0:
            raise ReferenceFileError(f"{path}: {name}: found shape {data[name].shape}, expected {shape}")
    for name in ARRAYS:
        if data[name].dtype.kind != "f" or not np.isfinite(data[name]).all():
            raise ReferenceFileError(f"{path}: {name}: found something else, expected finite numbers")
    times_s = data["gate_times_s"]
    if times_s.ndim != 1 or times_s.size == 0 or (np.diff(times_s, prepend=0.0) < 0.0).any():
        found = f"{times_s.shape}, {quote_value(times_s.tolist())}"
        raise ReferenceFileError(f"{path}: gate_times_s: found {found}, expected a row of growing times, s")
    most = np.abs(data["commands"]).max()
    if most > 1.0 + BEYOND:
        raise ReferenceFileError(f"{path}: commands: found {most:.7g}, expected within [-1, 1]")


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the arrays and the notes of a reference file; raises ReferenceFileError."""
    try:
        data = load_npz(path, LARGEST_BYTES)
        missing = [name for name in (*ARRAYS, "notes") if name not in data]
        if missing:
            raise NpzError(f"{', '.join(missing)}: missing")
        notes = json.loads(str(data.pop("notes")))
    except (OSError, ValueError, RecursionError) as error:  # ValueError: NpzError, no text, no JSON
        raise ReferenceFileError(
            f"{path}: cannot be read: {error_text(error)}; expected a reference file"
        ) from error
    missing = [name for name in NOTES if not isinstance(notes, dict) or name not in notes]
    if missing:
        raise ReferenceFileError(f"{path}: notes: {', '.join(missing)}: missing")
    if notes["version"] != FILE_VERSION:
        found = quote_value(notes["version"])
        raise ReferenceFileError(f"{path}: version: found {found}, expected {FILE_VERSION}")
    _check_notes(path, notes)
    return data, notes


def _check_notes(path: Path, notes: dict[str, Any]) -> None:
    """Raise ReferenceFileError for notes of wrong types, times that are not positive, or an unknown kind."""
    kinds = {**dict.fromkeys(TEXTS, (str, "a text")), "found": (dict, "an object")}
    for name, (kind, expected) in kinds.items():
        if not isinstance(notes[name], kind):
            raise ReferenceFileError(f"{path}: {name}: found {quote_value(notes[name])}, expected {expected}")
    for name in ("dt_s", "time_s"):
        found, value = quote_value(notes[name]), notes[name]
        if type(value) not in (int, float) or not 0.0 < value < LONGEST_S:
            raise ReferenceFileError(f"{path}: {name}: found {found}, expected seconds above 0")
    if notes["kind"] not in KINDS:
        found = quote_value(notes["kind"])
        raise ReferenceFileError(f"{path}: kind: found {found}, expected one of {', '.join(KINDS)}")


def _model_of(path: Path, values: Any) -> ModelParameters:
    """Return the model of a file's JSON values in float64; raises ReferenceFileError."""
    try:
        model_from_json(values, path)  # checks types and ranges
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
            flight, commands beyond [-1, 1], notes of wrong types, or a model of another digest.
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


def shipped_references(track: Track, model_names: tuple[str, ...]) -> References:
    """Return the references of a track by kind, for the first of these models that it has them for.

    Raises:
        ReferenceFileError: none for this track; the message lists those that exist.
    """
    names = [name for name in model_names if all(is_shipped(track.name, kind, name) for kind in KINDS)]
    name = names[0] if names else model_names[-1]
    references = {kind: shipped_reference(track.name, kind, name) for kind in KINDS}
    if any(reference.track_sha256 != track_digest(track) for reference in references.values()):
        raise ReferenceFileError(
            f"reference: {track.name}: found one of another track of that name, expected this track's"
        )
    return references


def is_model_of(track: str, model_name: str, model: ModelParameters) -> bool:
    """Return whether a track has a reference of that name for exactly this model."""
    if not is_shipped(track, "flying", model_name):
        return False
    return model_digest(model) == model_digest(shipped_reference(track, "flying", model_name).model)


def ghost_rollout(references: References, num_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return states (num_steps, 21) and commands (num_steps, 4) of the optimum: start, then flying laps.

    Row t is the sample that is nearest in time, at most half a step off: laps are no whole number of steps.
    The ghost jumps where its start ends, because a standing start may pass its last gate anywhere.
    """
    standing, flying = references["standing"], references["flying"]
    times_s = standing.dt_s * np.arange(num_steps)
    is_start = times_s < standing.time_s
    within_s = np.where(is_start, times_s, (times_s - standing.time_s) % flying.time_s)
    rows = np.rint(within_s / standing.dt_s).astype(int)

    def pick(first: np.ndarray, later: np.ndarray) -> np.ndarray:
        picked = [source[np.minimum(rows, len(source) - 1)] for source in (first, later)]
        return np.where(is_start[:, None], *picked)

    return pick(standing.states, flying.states), pick(standing.commands, flying.commands)
