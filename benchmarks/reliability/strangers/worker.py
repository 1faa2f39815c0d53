"""Damages and loads files of one kind, one after the other, and says what came of each: a line of JSON each.

``python -m benchmarks.reliability.strangers.worker KIND --seed S --first N --last N --folder F``; with the
numbers of an example it makes and loads that file again. It ends with the process where a load ends it.
"""

import argparse
import ast
import importlib
import json
import sys
import traceback
import warnings
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.reliability.strangers.kind import Kind
from benchmarks.reliability.strangers.watch import CPU_S, Watch, bounded, children, cpu_of

KINDS_MODULE = "benchmarks.reliability.strangers.kinds"
LONGEST_MESSAGE = 4000  # characters of a message that can still be read
LONGEST_TEXT = 600  # of what is kept of one


class Outcome(NamedTuple):
    """What came of a load.

    sort: "loaded", "refused", or what broke the promise: "unsound", "other error", "unclear", "forbidden",
    "memory", "time", "refused though well". text: what it said. cpu_s: with all processes that worked for it.
    """

    sort: str
    text: str
    cpu_s: float


def content_of(
    name: str, kind: Kind, seed: int, number: int, wells: list[bytes], hostile: list[bytes]
) -> bytes:
    """Return a file's content by its number: first what is well, then what is hostile, then damage."""
    if number < len(wells):
        return wells[number]
    if number < len(wells) + len(hostile):
        return hostile[number - len(wells)]
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), number])
    return kind.mutate(rng, wells)


def _has_no_memory(error: BaseException | None) -> bool:
    """Return whether an exception, or one that led to it, is that there was no memory left."""
    while error is not None:
        if isinstance(error, MemoryError) and not _is_of_parser(error):
            return True
        error = error.__cause__ or error.__context__
    return False


def _is_of_parser(error: BaseException) -> bool:
    """Return whether Python's parser raised an exception: it calls what is nested too deeply so, too."""
    return traceback.extract_tb(error.__traceback__)[-1].filename == ast.__file__


def _judge_error(kind: Kind, path: Path, error: BaseException) -> tuple[str, str]:
    text = f"{type(error).__name__}: {error}"
    if _has_no_memory(error):
        return "memory", text
    if type(error) is not kind.error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        return "other error", f"{text} ({Path(place.filename).name}, line {place.lineno})"
    said = str(error)
    is_printable = all(part.isprintable() for part in said.split("\n"))
    if f"{path.parent}/" not in said or len(said) > LONGEST_MESSAGE or not is_printable:
        return "unclear", text
    return "refused", text


def judge(kind: Kind, path: Path, watch: Watch, processes: list[int]) -> Outcome:
    """Load a file and return what came of it."""
    started_s = cpu_of(processes)
    found: Any = None
    sort, text = "loaded", ""
    watch.seen.clear()
    watch.is_on = True
    try:
        with bounded(bool(processes)):
            found = kind.load(path)
    except BaseException as error:
        sort, text = _judge_error(kind, path, error)
    watch.is_on = False
    cpu_s = cpu_of(processes) - started_s
    if sort == "loaded":
        try:
            kind.check(found)
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            sort, text = "unsound", f"{type(error).__name__}: {error}: {place.line}"
    if watch.seen:
        sort, text = "forbidden", f"{watch.seen[0]}; {text}"
    if cpu_s > CPU_S:
        sort = "time"
    return Outcome(sort, text[:LONGEST_TEXT], cpu_s)


def work(kind: Kind, name: str, seed: int, first: int, last: int, folder: Path) -> None:
    """Judge the files of some numbers; write a line each to standard output."""
    answers, sys.stdout = sys.stdout, sys.stderr
    sys.dont_write_bytecode = True
    warnings.simplefilter("ignore")  # of numbers that are too large for NumPy: what comes of them counts
    well_folder, work_folder = folder / f"{name}_well", folder / name
    for one in (well_folder, work_folder):
        one.mkdir(exist_ok=True)
    kind.write(well_folder)
    paths = sorted(well_folder.glob(f"*{kind.suffix}"))
    wells = [path.read_bytes() for path in paths]
    hostile = kind.hostile(wells)
    path = work_folder / f"file{kind.suffix}"
    for content in wells:  # what is imported and started once is no part of a load
        path.write_bytes(content)
        kind.check(kind.load(path))
    watch, processes = Watch(work_folder), children()
    print(json.dumps({"ready": len(wells), "hostile": len(hostile)}), file=answers, flush=True)
    for number in range(first, last):
        try:
            path.write_bytes(content_of(name, kind, seed, number, wells, hostile))
        except Exception as error:
            print(json.dumps({"mistake": f"{name}, number {number}: {error!r}"}), file=answers, flush=True)
            raise
        outcome = judge(kind, path, watch, processes)
        if number < len(wells) and outcome.sort == "refused":
            outcome = outcome._replace(sort="refused though well")
        print(json.dumps({"number": number, **outcome._asdict()}), file=answers, flush=True)


def main() -> None:
    """Judge the files of a kind that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, required=True, help="number of the first file")
    parser.add_argument("--last", type=int, required=True, help="number after that of the last file")
    parser.add_argument("--folder", type=Path, required=True, help="to write and load files in")
    parser.add_argument("--kinds", default=KINDS_MODULE, help="module that has them (default: %(default)s)")
    given = parser.parse_args()
    kinds: dict[str, Kind] = importlib.import_module(given.kinds).KINDS
    if given.kind not in kinds:
        parser.error(f"found {given.kind!r}, expected one of {', '.join(kinds)}")
    work(kinds[given.kind], given.kind, given.seed, given.first, given.last, given.folder)


if __name__ == "__main__":
    main()
