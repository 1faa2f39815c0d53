"""Suites: frozen tasks in a JSON file, with a digest that shows a change of any of them."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

from msgspec import Meta

from flytrack_bench.hidden import HiddenPlant, Truth
from flytrack_env import Track, TrackError, load_track
from flytrack_env.files import read_at_most
from flytrack_env.messages import error_text
from flytrack_env.plants import Plant, Simulator
from flytrack_env.references import track_digest
from flytrack_env.validation import Fields, Positive, Text, convert

FOLDER = Path(__file__).parent / "suites"
MAX_BYTES = 2**20
CRAFT_FIELDS = ("tau", "coeffs", "max_rate", "drain", "mass", "gravity", "effects")
Count = Annotated[int, Meta(ge=0)]
File = TypeVar("File", bound=Fields)


class SuiteError(ValueError):
    """A suite that cannot be used.

    The message names file and field, what was found and what was expected.
    """


@dataclass(frozen=True)
class Task:
    """A course and what flies it.

    Attributes:
        craft: of a hidden plant; None: the simulator's nominal drone.
        optimal_lap_s: the nominal drone's time-optimal flying lap, by which lap times are divided.
    """

    id: str
    track: Track
    craft: Truth | None
    optimal_lap_s: float

    @property
    def plant(self) -> Plant:
        """What moves the drone."""
        return Simulator() if self.craft is None else HiddenPlant(self.craft)


@dataclass(frozen=True)
class Suite:
    """A set of tasks.

    Attributes:
        starts: perturbed starts per task.
        laps: to fly from each.
        steps: at most, of a flight.
    """

    name: str
    digest: str
    seed: int
    starts: int
    laps: int
    steps: int
    tasks: tuple[Task, ...]

    def chosen(self, ids: tuple[str, ...]) -> tuple[Task, ...]:
        """Return tasks by their ids, all without any; raises SuiteError for an unknown one."""
        known = {task.id: task for task in self.tasks}
        for one in ids:
            if one not in known:
                raise SuiteError(f"tasks: found {one!r}, expected some of {', '.join(known)}")
        return tuple(known[one] for one in ids or known)


def digest_of(content: dict[str, Any]) -> str:
    """Return the digest of a suite's JSON values but for its own, hexadecimal."""
    rest = {name: value for name, value in content.items() if name != "digest"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def read_suite(path: Path, kind: type[File]) -> File:
    """Return the content of a suite's file as a struct, which has a ``digest``.

    Raises:
        SuiteError: a file that cannot be read, or one that was changed since it was written.
    """
    try:
        content = json.loads(read_at_most(path, MAX_BYTES))
    except OSError as error:
        raise SuiteError(f"{path}: cannot be read: {error_text(error)}") from error
    except (ValueError, RecursionError) as error:
        raise SuiteError(f"{path}: not a suite: {error_text(error)}") from error
    file = convert(str(path), content, kind, SuiteError)
    if digest_of(content) != content["digest"]:
        raise SuiteError(
            f"{path}: digest: does not belong to the content, so that the file was changed"
        )
    return file


def load_suite(name_or_path: str | Path) -> Suite:
    """Return a shipped suite by name, or that of a ``.json`` file.

    Raises:
        SuiteError: an unknown name, a file that cannot be read, or one that was changed since it
            was written.
    """
    path = Path(name_or_path)
    if path.suffix != ".json":
        path = FOLDER / f"{name_or_path}.json"
        known = sorted(shipped.stem for shipped in FOLDER.glob("*.json"))
        if str(name_or_path) not in known:
            expected = f"one of {', '.join(known)}, or a .json file"
            raise SuiteError(f"suite: found {str(name_or_path)!r}, expected {expected}")
    file = read_suite(path, _SuiteFile)
    tasks = tuple(_task(path, task) for task in file.tasks)
    return Suite(file.name, file.digest, file.seed, file.starts, file.laps, file.steps, tasks)


class _TaskFields(Fields):
    id: Text
    track: Text
    track_sha256: Text
    craft: Truth | None
    optimal_lap_s: Positive


class _SuiteFile(Fields):
    name: Text
    digest: Text
    seed: Count
    starts: Count
    laps: Count
    steps: Count
    tasks: tuple[_TaskFields, ...]


def _task(path: Path, task: _TaskFields) -> Task:
    try:
        track = load_track(path.parent / task.track if task.track.endswith(".toml") else task.track)
    except TrackError as error:
        raise SuiteError(f"{path}: {error}") from error
    if track_digest(track) != task.track_sha256:
        raise SuiteError(f"{path}: {task.track}: the track was changed")
    return Task(task.id, track, task.craft, task.optimal_lap_s)


def craft_as_json(craft: Truth) -> dict[str, Any]:
    """Return a hidden drone as JSON values: its parameters and its effects."""
    return {name: getattr(craft, name) for name in CRAFT_FIELDS}
