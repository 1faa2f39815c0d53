"""Time-optimal flights of a track with a model: their files, and the ghost that flies them.

The folder has those of the shipped tracks; ``benchmarks.time_optimal`` found them. A file is an
``.npz`` of numbers and one JSON text: states and commands at 100 Hz, gate times, the model itself,
and how the flight was found. It is read without unpickling.
"""

import dataclasses
import hashlib
import io
import json
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from flytrack_env.dynamics import ModelParameters
from flytrack_env.files import write_atomically
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_env.model_file import model_as_json, model_from_json
from flytrack_env.npz_file import load_npz
from flytrack_env.state import ACTION_SIZE, STATE_SIZE
from flytrack_env.tracks import Track
from flytrack_env.validation import convert

__all__ = [
    "FOLDER",
    "KINDS",
    "Reference",
    "ReferenceFileError",
    "References",
    "ghost_restarts",
    "ghost_rollout",
    "is_model_of",
    "load_reference",
    "model_digest",
    "save_reference",
    "shipped_path",
    "shipped_reference",
    "shipped_references",
    "track_digest",
]

FOLDER = Path(__file__).parent
KINDS = ("flying", "standing")
FILE_VERSION = 1
COPIED = ("track", "track_sha256", "kind", "model_name", "dt_s", "time_s", "found")
MAX_BYTES = 16 * 2**20  # in the file, and unpacked: hours of flight
MAX_TIME_S = 3600.0  # of a lap, or of one step
COMMAND_TOLERANCE = 1e-6  # of a command beyond full stick: the solver's tolerance


class ReferenceFileError(ValueError):
    """A reference file that cannot be used.

    The message names file and field, what was found and what was expected.
    """


@dataclasses.dataclass(frozen=True, eq=False)
class Reference:
    """A time-optimal flight, sampled at the simulator's step.

    Attributes:
        track, model_name: names.
        track_sha256: digest of the track.
        kind: "flying", a lap from the last gate's plane to itself, periodic except for the battery;
            or "standing", from rest at the start pose through every gate once.
        model: that it is optimal for.
        dt_s: s.
        time_s: to the last gate's plane, s; for "flying" the lap time.
        states: (N + 1, 21), float64, laid out as in ``flytrack_env.state``.
        commands: (N, 4), each held over its step; the last gate is passed in the last step.
        gate_times_s: (num_gates,), s from the first state.
        found: how it was found, JSON values (solver, status, seconds, versions, command).
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
    notes = {
        "version": FILE_VERSION,
        **{name: getattr(reference, name) for name in COPIED},
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


def _check_arrays(data: dict[str, np.ndarray]) -> None:
    """Raise ValueError for wrong shapes, infinite numbers or NaN, or commands beyond [-1, 1]."""
    num_steps = data["commands"].shape[:1]
    shapes = {
        "states": (*(size + 1 for size in num_steps), STATE_SIZE),
        "commands": (*num_steps, ACTION_SIZE),
        "gate_times_s": data["gate_times_s"].shape[:1],
    }
    for name, shape in shapes.items():
        array = data[name]
        if array.shape != shape or array.size == 0:
            raise ValueError(f"{name}: found shape {array.shape}, expected {shape}")
        if array.dtype.kind != "f" or not np.isfinite(array).all():
            raise ValueError(f"{name}: found something else, expected finite numbers")
    if (np.diff(data["gate_times_s"], prepend=0.0) < 0.0).any():
        raise ValueError(
            f"gate_times_s: found {quote_value(data['gate_times_s'])}, expected growing times, s"
        )
    most = np.abs(data["commands"]).max()
    if most > 1.0 + COMMAND_TOLERANCE:
        raise ValueError(f"commands: found {most:.7g}, expected within [-1, 1]")


Seconds = Annotated[float, Meta(gt=0.0, lt=MAX_TIME_S)]


class _Notes(msgspec.Struct):
    version: Literal[1]
    track: str
    track_sha256: str
    kind: Literal["flying", "standing"]
    model_name: str
    model_sha256: str
    model: dict[str, Any]
    dt_s: Seconds
    time_s: Seconds
    found: dict[str, Any]


def load_reference(path: str | Path) -> Reference:
    """Return the reference in a file.

    Raises:
        ReferenceFileError: missing or damaged file, pickled objects, another version, arrays that
            are no flight, commands beyond [-1, 1], notes of wrong types, or a model of another
            digest.
    """
    path = Path(path)
    try:
        data = load_npz(path, MAX_BYTES)
        notes = convert("", json.loads(str(data.pop("notes"))), _Notes)
        _check_arrays(data)
        model = model_from_json(notes.model, path, float)
        if model_digest(model) != notes.model_sha256:
            raise ValueError("model: found another one than its digest, expected the same")
        return Reference(
            **{name: getattr(notes, name) for name in COPIED},
            model=model,
            states=data["states"].astype(float),
            commands=np.clip(data["commands"].astype(float), -1.0, 1.0),
            gate_times_s=data["gate_times_s"].astype(float),
        )
    except KeyError as error:
        raise ReferenceFileError(f"{path}: {quote_name(error.args[0])}: missing") from error
    except (OSError, RecursionError, ValueError) as error:  # NpzError, no JSON, a check
        raise ReferenceFileError(
            f"{path}: cannot be read: {error_text(error)}; expected a reference file"
        ) from error


def shipped_references(track: Track, model_names: tuple[str, ...]) -> References:
    """Return the references of a track by kind, for the first of these models that it has them for.

    Raises:
        ReferenceFileError: none for this track; the message lists those that exist.
    """
    names = [
        name for name in model_names if all(is_shipped(track.name, kind, name) for kind in KINDS)
    ]
    name = names[0] if names else model_names[-1]
    references = {kind: shipped_reference(track.name, kind, name) for kind in KINDS}
    if any(reference.track_sha256 != track_digest(track) for reference in references.values()):
        raise ReferenceFileError(
            f"reference: {track.name}: found one of another track of that name, "
            "expected this track's"
        )
    return references


def is_model_of(track: str, model_name: str, model: ModelParameters) -> bool:
    """Return whether a track has a reference of that name for exactly this model."""
    if not is_shipped(track, "flying", model_name):
        return False
    return model_digest(model) == model_digest(shipped_reference(track, "flying", model_name).model)


def ghost_rollout(references: References, num_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the optimum's states (num_steps, 21) and commands (num_steps, 4).

    It is a standing start, then flying laps. Row t is the sample that is nearest in time, at most
    half a step off: laps are no whole number of steps. The ghost jumps where its start ends,
    because a standing start may pass its last gate anywhere (``ghost_restarts``).
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


def ghost_restarts(references: References, num_steps: int) -> np.ndarray:
    """Return the rows of ``ghost_rollout`` at which a flight of it begins, (num_steps,) bool.

    Across these the ghost does not move: it goes to the beginning of a flying lap, with the battery
    of that. Row 0 is one.
    """
    standing, flying = references["standing"], references["flying"]
    times_s = standing.dt_s * np.arange(num_steps)
    laps = np.floor((times_s - standing.time_s) / flying.time_s)
    number = np.maximum(laps, -1.0)  # -1: the standing start, however long that is
    return np.diff(number, prepend=-2.0) > 0.0
