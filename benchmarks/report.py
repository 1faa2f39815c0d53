"""What all benchmarks share: Markdown tables and pages, and records of measurements.

A record says what was measured, where and when.

Nothing here imports JAX at the top, so that ``pin_to_one_core`` can run before JAX starts its
threads.
"""

import importlib
import itertools
import json
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from typing import Annotated, Any, NamedTuple, TypeVar

import tyro
from scipy.stats import binomtest
from tqdm import tqdm

Item = TypeVar("Item")
Line = dict[str, Any]  # what was measured of something, JSON values
ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "docs" / "results"
FEW = 20  # values of which a share would claim more digits than they have
PACKAGES = ("jax", "jaxlib", "gymnax", "numpy")
_num_measured = itertools.count()  # trials, by this process


@dataclass(frozen=True)
class Jobs:
    """Where trials are measured."""

    workers: int = 0
    """Processes of this machine that measure trials; 0: this process does, one after the other."""
    address: str | None = None
    """A Ray cluster that measures them, HOST:PORT, "auto" for the one that runs here, or "local"
    for one that is begun; its nodes need this checkout at the same path."""
    limit_s: float = 7200.0
    """Longest time of a trial (s), with --workers or --address."""


JobFlags = Annotated[Jobs, tyro.conf.arg(name="")]
IN_THIS_PROCESS = Jobs()


def command(main: Callable[..., None]) -> None:
    """Call a benchmark's ``main`` with the flags of the command line, which are its arguments."""
    spec = sys.modules["__main__"].__spec__
    if main.__module__ == "__main__" and spec is not None:
        # Jobs in other processes find nothing by that name.
        main = getattr(importlib.import_module(spec.name), main.__name__)
    text = f"{sys.modules['__main__'].__doc__}\n{main.__doc__}"
    tyro.cli(main, description=text, config=(tyro.conf.FlagCreatePairsOff,))


def pin_to_one_core() -> str:
    """Keep this process, and the libraries it loads later, on one core; return what was done."""
    os.environ["OMP_NUM_THREADS"] = "1"
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    if not hasattr(os, "sched_setaffinity"):
        return "not pinned: this system has no sched_setaffinity"
    core = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {core})
    return f"pinned to core {core}"


def cpu_name() -> str:
    """Return the processor's name as the system gives it."""
    path = Path("/proc/cpuinfo")
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    name = re.search(r"^model name\s*: (.+)", text, re.MULTILINE)
    return name[1] if name else platform.processor() or platform.machine()


def commit_of_checkout() -> str:
    """Return the checkout's commit, with ``-dirty`` if tracked files but results changed."""

    def git(*command: str) -> str:
        run = subprocess.run(
            ["git", *command], cwd=ROOT, check=True, capture_output=True, text=True
        )
        return run.stdout.strip()

    try:
        measured = (":!docs/results", ":!benchmarks/data")
        changed = git("status", "--porcelain", "--untracked-files=no", "--", ".", *measured)
        return git("describe", "--always", "--exclude=*") + ("-dirty" if changed else "")
    except (OSError, subprocess.CalledProcessError):  # a copy without git
        return "unknown"


def command_line() -> str:
    """Return the command that runs now, as a page names it."""
    spec = sys.modules["__main__"].__spec__
    module = spec.name.removesuffix(".__main__") if spec is not None else "benchmarks"
    return f"`{shlex.join(['python', '-m', module, *sys.argv[1:]])}`"


def provenance(*packages: str) -> Line:
    """Return what every record names: commit, date, machine and versions, as JSON values.

    Args:
        packages: whose versions matter besides those of ``PACKAGES``; "not installed" if missing.
    """
    versions = {"python": platform.python_version()}
    for package in (*PACKAGES, *packages):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return {
        "commit": commit_of_checkout(),
        "date": str(date.today()),
        "machine": f"{cpu_name()}, {os.cpu_count()} cores",
        "versions": versions,
    }


def provenance_line(record: Line) -> str:
    """Return a record's provenance as the last line of a page."""
    packages = ", ".join(f"{name} {number}" for name, number in record["versions"].items())
    return (
        f"Measured at commit {record['commit']} on {record['date']}; {record['machine']}; "
        f"{packages}."
    )


def table(header: str | Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table in Markdown, without a newline at its end.

    Args:
        header: "column | column" or a sequence.
    """
    columns = header.split(" | ") if isinstance(header, str) else header
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


class Figure(NamedTuple):
    """A figure of a page: name, target ("" for none), what was measured, number of values."""

    name: str
    target: str
    measured: str
    n: int | str = ""


def figures_table(figures: Iterable[Figure]) -> str:
    """Return figures as a table in Markdown."""
    return table("figure | target | measured | n", figures)


def share_figure(name: str, target: str, flags: Sequence[bool | int]) -> Figure:
    """Return a figure that is the share of true values."""
    return Figure(name, target, *share(flags))


def share(flags: Sequence[bool | int]) -> tuple[str, int]:
    """Return the share of true values as text, "none" of no values, and the number of values.

    A share of fewer than ``FEW`` is a count, others have their exact 95 % interval.
    """
    count, total = sum(map(bool, flags)), len(flags)
    if total < FEW:
        return f"{count} of {total}" if total else "none", total
    low, high = binomtest(count, total).proportion_ci(0.95, method="exact")
    return f"{count / total:.1%} ({low:.1%} to {high:.1%})".replace("%", " %"), total


def spread(values: Sequence[float], digits: str = ",.0f") -> str:
    """Return the lowest and the highest value as text."""
    return f"{min(values):{digits}} to {max(values):{digits}}"


def median_and_spread(values: Sequence[float], digits: str) -> str:
    """Return the median with the lowest and the highest value as text; "none" of no values."""
    return f"{median(values):{digits}} ({spread(values, digits)})" if values else "none"


def list_settings(values: dict[str, float]) -> str:
    """Return settings as a list in a sentence."""
    return ", ".join(f"{name} {value:g}" for name, value in values.items())


def progress(items: Iterable[Item], unit: str, total: int | None = None) -> Iterable[Item]:
    """Return items with a progress bar, shown on a terminal only.

    Args:
        items: any.
        unit: what is counted.
        total: number of items; None: their length, if they have one.
    """
    from flytrack_env.progress import TerminalBar  # not at the top: it imports JAX

    return TerminalBar(items, unit=f" {unit}", total=total, disable=None)


def filled(name: str, /, **values: Any) -> str:
    """Return a template of ``benchmarks/pages`` with values filled in."""
    template = ROOT / "benchmarks" / "pages" / f"{name}.md"
    return template.read_text(encoding="utf-8").format(**values)


def fill_page(path: Path | None, name: str, /, packages: Sequence[str] = (), **values: Any) -> None:
    """Print a page and write it atomically, as of ``filled``.

    ``{command}`` and ``{provenance}`` need not be given. packages: as for ``provenance``.
    """
    source = provenance_line(provenance(*packages))
    write_page(path, filled(name, command=command_line(), provenance=source, **values))


def write_page(path: Path | None, text: str) -> None:
    """Print a page and write it atomically; path: None to print only."""
    print(text, end="", flush=True)
    if path is not None:
        _write(path, text)


def write_json(path: Path, value: Any) -> None:
    """Write JSON values atomically, indented."""
    _write(path, json.dumps(value, indent=1) + "\n")


def append_line(path: Path, line: Line) -> None:
    """Append JSON values to a file as a line."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line, default=str) + "\n")


def lines_in(path: Path) -> list[Line]:
    """Return the lines of JSON in a file, none if there is no file."""
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    # What a kill has cut off has no end of line.
    return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]


def select(lines: Iterable[Line], **fields: Any) -> list[Line]:
    """Return the lines whose fields have these values."""
    return [line for line in lines if fields.items() <= line.items()]


def good_lines(lines: Iterable[Line]) -> list[Line]:
    """Return the lines of trials that did not crash."""
    # A measured field may have that name, too: ratios of errors.
    return [line for line in lines if not isinstance(line.get("error"), str)]


def record_trials(
    path: Path,
    trials: Iterable[Any],
    measure: Callable[[Any], Line],
    programs_kept: int | None = None,
    jobs: Jobs = IN_THIS_PROCESS,
    code: Sequence[str] = (),
) -> None:
    """Measure trials without a line of this commit or its code, and append a line of JSON for each.

    Prints a summary of each line, and how many there are.

    A line has the trial's fields, the commit, date and machine, and what was measured, or the
    error: a crash is a result too, and the others go on. This process alone writes to the file.

    Args:
        path: file of lines.
        trials: named tuples.
        measure: returns what is measured of a trial; a function of a module.
        programs_kept: trials after which a process drops its compiled programs, None for never; the
            system limits how many memory mappings a process may have.
        jobs: where trials are measured.
        code: as of ``lines_of_commit``.

    Raises:
        OSError: no such cluster.
    """
    from flytrack_env.jobs import run_jobs  # not at the top: it imports JAX

    machine = f"{platform.machine()}, {os.cpu_count()} cores, jax {version('jax')}"
    stamp = {"commit": commit_of_checkout(), "date": str(date.today()), "machine": machine}
    done = lines_of_commit(path, stamp["commit"], code)

    def is_done(trial: Any) -> bool:
        return bool(select(done, **json.loads(json.dumps(trial._asdict()))))

    remaining = {_job_name(trial): trial for trial in trials if not is_done(trial)}
    arguments = {name: (measure, trial, programs_kept) for name, trial in remaining.items()}
    results: Iterable[tuple[str, dict[str, Any]]]
    if jobs.workers or jobs.address is not None:
        outcomes = run_jobs(measure_trial, arguments, jobs.limit_s, jobs.address, jobs.workers)
        results = ((name, outcome.value or {"error": outcome.error}) for name, outcome in outcomes)
    else:
        results = ((name, measure_trial(*values)) for name, values in arguments.items())
    for name, result in progress(results, "trials", len(remaining)):
        append_line(path, {**remaining[name]._asdict(), **stamp, **result})
        tqdm.write(f"{name}: {summarize_result(result)}")
    print(f"{path}: {len(remaining)} lines added; trials with a line of this commit are left out")


def summarize_result(result: Line) -> str:
    """Return the hidden truth of a trial and what was found of it, as text.

    Args:
        result: what was measured of a trial; an error, or anything without a truth, as well.
    """
    parts = []
    for key in ("truth", "verdict", "causes", "named", "law", "error"):
        value = result.get(key)
        if isinstance(value, list):
            names = (item["effect"] if isinstance(item, dict) else str(item) for item in value)
            value = ", ".join(names) or "none"
        if value is not None:
            parts.append(f"{key}: {value}")
    return "; ".join(parts) or "measured"


def _job_name(trial: Any) -> str:
    """Return a trial's values as text: the name of its job."""
    return " ".join(map(str, trial))


def measure_trial(
    measure: Callable[[Any], dict[str, Any]], trial: Any, programs_kept: int | None
) -> dict[str, Any]:
    """Return what is measured of a trial, or the error; called in any process."""
    if programs_kept and next(_num_measured) % programs_kept == 0:
        import jax

        jax.clear_caches()
    try:
        return measure(trial)
    except Exception as error:
        return {"error": f"{type(error).__name__}: {error}"}


def lines_of_commit(path: Path, commit: str | None = None, code: Sequence[str] = ()) -> list[Line]:
    """Return the lines in a file that were measured at a commit; None: at that of the last line.

    Args:
        code: files and folders that decide what is measured. Lines of other commits count, too, if
            these are the same there.
    """
    lines = lines_in(path)
    commit = lines[-1]["commit"] if commit is None and lines else commit
    is_counted = {
        other: other == commit or is_unchanged(code, other, commit) for other in list_commits(lines)
    }
    return [line for line in lines if is_counted[line["commit"]]]


def list_commits(lines: Iterable[Line]) -> list[str]:
    """Return the commits of lines, each once."""
    return list(dict.fromkeys(line["commit"] for line in lines))


def is_unchanged(code: Sequence[str], commit: str, other: str | None) -> bool:
    """Return whether some files are the same at two commits; False for none, and without git."""
    if not code or other is None:
        return False
    command = ["git", "diff", "--quiet", commit, other, "--", *code]
    try:
        return subprocess.run(command, cwd=ROOT, check=False, capture_output=True).returncode == 0
    except OSError:
        return False


def _write(path: Path, text: str) -> None:
    from flytrack_env.files import write_atomically  # not at the top: it imports JAX

    write_atomically(path, text.encode())
