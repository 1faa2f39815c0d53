"""A fleet: a folder of logs of many craft, each log diagnosed, and what began on which craft when.

Each log is checked and diagnosed alone, in a process of its own. Where the diagnoses of a craft's
flights suggest that a cause began or ended, or a note tells of a repair, flights after are compared
with flights before (``diagnose_change``), and only what both say is told.
"""

import glob
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from hashlib import file_digest, sha256
from pathlib import Path
from typing import Any, NamedTuple

from flytrack_env import load_model
from flytrack_env.files import open_file, read_at_most, write_atomically
from flytrack_env.jobs import Outcome, run_jobs
from flytrack_env.messages import error_text, quote_name
from flytrack_env.sources import digest_of_sources
from flytrack_env.toml_file import TomlError, parse_toml, read_text
from flytrack_sysid.diagnosis import diagnose, diagnose_change
from flytrack_sysid.importing import import_log
from flytrack_sysid.importing.file_kinds import NUM_BYTES, identify
from flytrack_sysid.log import FlightLog, LogError
from flytrack_sysid.log_file import SUFFIXES, load_log
from flytrack_sysid.plausibility import check_plausible

MODEL, MAPPING, NOTES = "model.json", "mapping.toml", "notes.toml"
OWN_FILES = (MODEL, MAPPING, NOTES)
COPIED = "copied"  # below OUT: what URLs name
MAX_RESULT_BYTES = 2**24
# A change needs flights on both sides, as single diagnoses name what is not there now and then.
MIN_FLIGHTS = 3
MIN_NAMED, MAX_NAMED_ELSEWHERE = 0.75, 0.125  # shares of the flights with the cause, and without
FLIGHTS_COMPARED = 4  # on either side: more cost more and tell little more
DIAGNOSED, CONTRADICTS, UNREADABLE = "diagnosed", "contradicts", "unreadable"
FAILED = "failed"  # a job without a result, which the next call runs again


class FleetError(ValueError):
    """A folder that is no fleet; the message says what was found and expected."""


class Flight(NamedTuple):
    """A log of a fleet.

    Attributes:
        craft: name of the folder that holds the log, with those above where others have its name.
        path: of the log.
        model: path of the craft's model; None: the nominal one.
        mapping: path of the craft's mapping; None: none.
        note: what was done before this flight, by ``notes.toml``.
    """

    craft: str
    path: str
    model: str | None = None
    mapping: str | None = None
    note: str = ""

    @property
    def name(self) -> str:
        """Craft and file."""
        return f"{self.craft}/{Path(self.path).name}"


@dataclass(frozen=True)
class Change:
    """What changed on a craft at a flight.

    Attributes:
        craft: name.
        flight: number of the first flight after the change, of all the craft's, from 1.
        before: file of the last flight before it; empty for a note on the first.
        since: file of the first flight after it.
        note: what ``notes.toml`` or the logs' settings say of the time between.
        has_ended: whether the causes end here instead of begin.
        causes: effects with their parameters; none where only a note is known.
        failure: why flights after and before could not be compared; empty where they were.
    """

    craft: str
    flight: int
    before: str
    since: str
    note: str
    has_ended: bool
    causes: dict[str, dict[str, Any]]
    failure: str = ""


class Place(NamedTuple):
    """Where something may have changed: a craft's diagnosed flights, and the first one after it."""

    flights: list[Flight]
    first: int
    has_ended: bool

    @property
    def name(self) -> str:
        """Craft, file, and what is looked for."""
        flight = self.flights[self.first]
        what = "ended" if self.has_ended else "begun"
        return f"{flight.craft}/{what} at {Path(flight.path).name}"

    @property
    def compared(self) -> tuple[list[Flight], list[Flight]]:
        """The flights with the causes that are looked for, and those without."""
        before = self.flights[max(self.first - FLIGHTS_COMPARED, 0) : self.first]
        after = self.flights[self.first : self.first + FLIGHTS_COMPARED]
        return (before, after) if self.has_ended else (after, before)


def natural(name: str) -> list[Any]:
    """Return a key by which flight 9 comes before flight 12."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def fetch(url: str, cache: Path) -> Path:
    """Copy the folder of a URL, such as s3://bucket/logs, and return the copy.

    Raises:
        FleetError: a name that leads out of the copy.
        ImportError, OSError: fsspec, or what it needs for the URL, is not installed or fails.
    """
    from flytrack_env.extras import check_installed

    check_installed("cluster", "folders of other systems", "fsspec")
    import fsspec

    system, root = fsspec.core.url_to_fs(url)
    for remote in system.find(root):
        local = cache / str(remote).removeprefix(root.rstrip("/")).lstrip("/")
        if not local.resolve().is_relative_to(cache.resolve()):
            raise FleetError(f"{url}: {quote_name(str(remote))}: found a name that leads out of it")
        if not (local.exists() and local.stat().st_size == system.size(remote)):
            local.parent.mkdir(parents=True, exist_ok=True)
            partly = local.with_name(f".{local.name}.part")
            system.get(remote, str(partly))
            os.replace(partly, local)
    return cache


def expand(paths: Iterable[Path], out: Path) -> list[Path]:
    """Return folders and files of arguments, of which some are patterns or URLs.

    Args:
        paths: such as logs, ``logs/*/2026*.bbl`` or ``s3://bucket/logs``.
        out: folder of the fleet; what is copied from elsewhere is below it.

    Raises:
        FleetError: nothing there.
    """
    expanded: list[Path] = []
    for path in paths:
        if parts := re.fullmatch(r"(\w{2,}):/+(.+)", str(path)):  # a path has one of its slashes
            url = f"{parts[1]}://{'/' * (parts[1] == 'file')}{parts[2]}"
            copy = out / COPIED / sha256(url.encode()).hexdigest()[:12] / path.name
            expanded.append(fetch(url, copy))
            continue
        names = [path] if path.exists() else sorted(glob.glob(str(path), recursive=True))
        found = [Path(name) for name in names]
        if not found:
            raise FleetError(f"{path}: found nothing there, expected a folder of flight logs")
        expanded += found
    return expanded


def find_flights(
    paths: Sequence[Path], model: Path | None, out: Path | None = None
) -> list[Flight]:
    """Return the flights in folders and files, by craft and in the order of their names.

    Args:
        paths: folders, which are searched with their subfolders, and files.
        model: of craft whose folder has no ``model.json``; None: the nominal one.
        out: folder of the fleet, whose own files are no logs.

    Raises:
        FleetError: no file, or notes that cannot be read or are on no file.
    """
    by_folder: dict[Path, set[str]] = {}
    for path in paths:
        for file in [path] if path.is_file() else path.rglob("*"):
            folder = file.parent.resolve()  # the file itself may be a link, as of git-annex
            is_own = out is not None and folder.is_relative_to(out.resolve())
            is_own &= not (out and folder.is_relative_to(out.resolve() / COPIED))
            is_log = file.name not in OWN_FILES and not file.name.startswith(".")
            if is_log and not is_own and file.is_file():
                by_folder.setdefault(folder, set()).add(file.name)
    if not by_folder:
        found = ", ".join(map(str, paths))
        raise FleetError(f"{found}: found no file, expected a folder for each craft, with its logs")
    flights = []
    for folder in sorted(by_folder):
        own, mapping = folder / MODEL, folder / MAPPING
        model_path = own if own.exists() else model
        notes = _read_notes(folder / NOTES)
        for name in sorted(by_folder[folder], key=natural):
            flights.append(
                Flight(
                    _craft_name(folder, by_folder),
                    str(folder / name),
                    None if model_path is None else str(model_path.resolve()),
                    str(mapping) if mapping.exists() else None,
                    notes.get(name, ""),
                )
            )
    return flights


def _craft_name(folder: Path, folders: Iterable[Path]) -> str:
    """Return as many of the last parts of a folder's path as no other one has."""
    for count in range(1, len(folder.parts) + 1):
        parts = folder.parts[-count:]
        if sum(other.parts[-count:] == parts for other in folders) == 1:
            break
    return "/".join(parts).lstrip("/")


def _read_notes(path: Path) -> dict[str, str]:
    if not path.exists():
        return {}
    try:
        notes = parse_toml(read_text(path))
    except (OSError, UnicodeDecodeError, TomlError) as error:
        raise FleetError(f"{path}: {error_text(error)}") from error
    for name, text in notes.items():
        if not isinstance(text, str):
            raise FleetError(f'{path}: {name}: expected text, as in "flight12.bbl" = "new motor"')
        if not (path.parent / name).is_file():
            raise FleetError(f"{path}: {quote_name(name)}: found no such file beside it")
    return notes


def read_flight(flight: Flight) -> tuple[FlightLog, dict[str, Any]]:
    """Return a log in any format that is known, and the craft's settings in its headers."""
    path = Path(flight.path)
    if path.suffix.lower() in SUFFIXES and flight.mapping is None:
        return load_log(path), {}
    with open_file(path, path.stat().st_size) as file:
        kind = identify(file.read(NUM_BYTES))
    if not kind.format or (kind.format == "csv" and flight.mapping is None):
        raise LogError(f"{path}: found {kind.name}, expected a flight log")
    imported = import_log(path, kind.format, flight.mapping)
    return imported.log, imported.craft.as_json()


def diagnose_flight(flight: Flight) -> dict[str, Any]:
    """Return the state of a log, and its check or diagnosis, as JSON values.

    Raises:
        OSError: no such file, as on a node that does not see it; it may see it in the next call.
    """
    Path(flight.path).stat()
    try:
        log, settings = read_flight(flight)
    except (LogError, OSError) as error:
        return {"state": UNREADABLE, "reason": error_text(error)}
    model = None if flight.model is None else load_model(flight.model)
    try:
        check_plausible(log, model=model)
    except LogError as error:
        return {"state": CONTRADICTS, "reason": error_text(error)}
    diagnosis = diagnose(log, model).as_json()
    return {"state": DIAGNOSED, "settings": settings, "diagnosis": diagnosis}


def compare_flights(later: Sequence[Flight], earlier: Sequence[Flight]) -> dict[str, Any]:
    """Return the diagnosis of what some flights have that others of the craft lack, as JSON."""
    logs, logs_before = ([read_flight(one)[0] for one in flights] for flights in (later, earlier))
    model = None if later[0].model is None else load_model(later[0].model)
    return {"causes": diagnose_change(logs, logs_before, model).as_json()["causes"]}


def key_of(function: Callable[..., Any], arguments: Any) -> str:
    """Return what a stored result belongs to: arguments, the files that they name, the code."""
    flat = json.dumps(arguments, ensure_ascii=False)
    code = digest_of_sources("flytrack_env", "flytrack_sysid")
    digest = sha256(f"{function.__name__} {flat} {code}".encode())
    for name in re.findall(r'"(/[^"]+)"', flat):
        if Path(name).is_file():
            with Path(name).open("rb") as file:
                digest.update(file_digest(file, "sha256").digest())
    return digest.hexdigest()


Runner = Callable[..., Iterable[tuple[str, Outcome]]]
Report = Callable[[int, int], None]


class Store:
    """Results of jobs in a folder, a JSON file each: a second call runs only what is missing.

    Args:
        folder: of the files.
        run: ``run_jobs`` with its limits.
    """

    def __init__(self, folder: Path, run: Runner):
        self.folder, self.run = folder, run

    def results(
        self, function: Callable[..., Any], jobs: dict[str, tuple[Any, ...]], report: Report
    ) -> dict[str, dict[str, Any]]:
        """Return the result of each job by name; one that failed has a state and a reason.

        A result is what JSON makes of it, whether it is new or read.
        """
        keys = {name: key_of(function, arguments) for name, arguments in jobs.items()}
        loaded = {name: self._load(name, key) for name, key in keys.items()}
        results = {name: result for name, result in loaded.items() if result is not None}
        missing = {name: arguments for name, arguments in jobs.items() if name not in results}
        report(len(results), len(jobs))
        for name, outcome in self.run(function, missing):
            result = outcome.value or {"state": FAILED, "reason": outcome.error}
            content = json.dumps({"key": keys[name], "name": name, **result})
            write_atomically(self._path(name), f"{content}\n".encode())
            results[name] = json.loads(content)
            report(len(results), len(jobs))
        return {name: results[name] for name in jobs}

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.json"

    def _load(self, name: str, key: str) -> dict[str, Any] | None:
        try:
            content = json.loads(read_at_most(self._path(name), MAX_RESULT_BYTES))
        except (OSError, ValueError):
            return None
        is_it = isinstance(content, dict) and content.get("key") == key
        return content if is_it and content.get("state") != FAILED else None


def names_of(result: dict[str, Any]) -> set[str]:
    """Return the effects that a diagnosis names, with those it cannot tell from them."""
    causes = result["diagnosis"]["causes"]
    return {name for cause in causes for name in (cause["effect"], *cause["equivalent"])}


def find_beginning(is_named: Sequence[bool]) -> int | None:
    """Return the first of a craft's flights with a cause that earlier ones lack; None if unclear.

    Most flights from there on must name it, and next to none before; where several flights could
    be the first, the one that contradicts the fewest diagnoses.
    """
    best, fewest = None, len(is_named)
    for first in range(MIN_FLIGHTS, len(is_named) - MIN_FLIGHTS + 1):
        before, after = is_named[:first], is_named[first:]
        is_clear = sum(after) >= MIN_NAMED * len(after)
        is_clear &= sum(before) <= MAX_NAMED_ELSEWHERE * len(before)
        errors = sum(before) + len(after) - sum(after)
        if is_named[first] and is_clear and errors < fewest:
            best, fewest = first, errors
    return best


def describe_settings(before: dict[str, Any], after: dict[str, Any]) -> str:
    """Return in words which settings in the logs' headers changed between two flights."""
    names = sorted(name for name in {**before, **after} if before.get(name) != after.get(name))
    return "; ".join(f"{name}: {before.get(name)} to {after.get(name)}" for name in names)


def find_places(flights: list[Flight], results: Sequence[dict[str, Any]]) -> list[Place]:
    """Return where something may have changed on a craft.

    Args:
        flights: its diagnosed ones.
        results: of each.
    """
    named = [names_of(result) for result in results]
    begun = {index for index, flight in enumerate(flights) if flight.note and index > 0}
    begun |= {
        index
        for index in range(1, len(flights))
        if results[index]["settings"] != results[index - 1]["settings"]
    }
    ended: set[int] = set()
    for effect in sorted(set[str]().union(*named)):
        flags = [effect in names for names in named]
        for indices, side in ((begun, flags), (ended, [not flag for flag in flags])):
            first = find_beginning(side)
            indices |= set() if first is None else {first}
    return [
        Place(flights, first, has_ended)
        for has_ended, indices in ((False, begun), (True, ended))
        for first in sorted(indices)
    ]


def settle(place: Place, named: list[set[str]], causes: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the causes of a comparison that the single diagnoses show at this place, too."""

    def is_shown(effect: str) -> bool:
        flags = [(effect in names) != place.has_ended for names in named]
        return find_beginning(flags) == place.first

    return {
        cause["effect"]: cause["parameters"]
        for cause in causes
        if any(map(is_shown, (cause["effect"], *cause["equivalent"])))
    }


def find_changes(
    flights: Sequence[Flight], results: dict[str, dict[str, Any]], store: Store, report: Report
) -> list[Change]:
    """Return what changed on each craft, as comparisons and single diagnoses say alike."""
    by_craft: dict[str, list[Flight]] = {}
    numbers, counts = {}, Counter[str]()
    notes: dict[str, str] = {}  # by craft, of logs since the last one that was diagnosed
    for flight in flights:
        counts[flight.craft] += 1
        numbers[flight.name] = counts[flight.craft]
        note = "; ".join(filter(None, (notes.pop(flight.craft, ""), flight.note)))
        if results[flight.name]["state"] == DIAGNOSED:
            by_craft.setdefault(flight.craft, []).append(flight._replace(note=note))
        else:
            notes[flight.craft] = note
    places: dict[str, Place] = {}
    for own in by_craft.values():
        places |= {one.name: one for one in find_places(own, [results[f.name] for f in own])}
    jobs = {name: place.compared for name, place in places.items()}
    changes = [
        Change(one.craft, numbers[one.name], "", Path(one.path).name, one.note, False, {})
        for one, *_ in by_craft.values()
        if one.note
    ]
    for name, compared in store.results(compare_flights, jobs, report).items():
        place = places[name]
        own, first = place.flights, place.first
        diagnoses = [results[flight.name] for flight in own]
        causes = settle(place, list(map(names_of, diagnoses)), compared.get("causes", []))
        failure = compared.get("reason", "")
        settings = describe_settings(*(one["settings"] for one in diagnoses[first - 1 : first + 1]))
        note = "; ".join(filter(None, (own[first].note, settings)))
        if causes or failure or (note and not place.has_ended):
            before, since = (Path(own[index].path).name for index in (first - 1, first))
            number = numbers[own[first].name]
            where = (own[first].craft, number, before, since)
            changes.append(Change(*where, note, place.has_ended, causes, failure))
    return sorted(changes, key=lambda change: (natural(change.craft), change.flight))


def diagnose_fleet(
    flights: Sequence[Flight],
    out: Path,
    limit_s: float,
    workers: int,
    address: str | None = None,
    report: Report = lambda done, total: None,
) -> tuple[dict[str, dict[str, Any]], list[Change]]:
    """Diagnose every flight that ``out`` has no result of, and compare where something changed.

    Args:
        flights: as ``find_flights`` returns them.
        out: folder; results are in ``out``/logs, changes in ``out``/changes.json.
        limit_s: longest time of a diagnosis (s).
        workers: processes of this machine, without ``address``.
        address: of a Ray cluster, as ``run_jobs`` takes it; its nodes must see the logs.
        report: called with jobs done and to do, of the diagnoses and then of the comparisons.

    Returns:
        Results by flight, and changes.
    """
    store = Store(
        out / "logs", partial(run_jobs, limit_s=limit_s, address=address, workers=workers)
    )
    jobs = {flight.name: (flight,) for flight in flights}
    results = store.results(diagnose_flight, jobs, report)
    changes = find_changes(flights, results, store, report)
    content = json.dumps([asdict(change) for change in changes], indent=1)
    write_atomically(out / "changes.json", (content + "\n").encode())
    return results, changes
