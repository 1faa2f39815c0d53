"""Benchmark of the check of conventions: ``python -m benchmarks.check``.

Logs are those of ``benchmarks.seams``: clean ones, ones with a fault, ones with two, and plants
with the conventions of ten simulators. Results are appended to docs/results/check.jsonl, and a
later run of the same commit resumes there; ``--page`` writes docs/results/check.md from them.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any, Literal, NamedTuple, get_args
from zlib import crc32

import numpy as np
from scipy.stats import binomtest

from benchmarks.report import (
    IN_THIS_PROCESS,
    RESULTS,
    JobFlags,
    Line,
    command,
    fill_page,
    good_lines,
    lines_of_commit,
    record_trials,
    select,
    table,
)
from benchmarks.seams.faults import FAULTS, UNITS, Change, Truth, draw_pair, inject, is_shown
from benchmarks.seams.flight import Flight, make_flight
from benchmarks.seams.mapped import MAPPING, import_csv, is_equal, write_csv
from benchmarks.seams.measured import measured_flights
from benchmarks.seams.simulators import SIMULATORS
from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_sysid.check import check_log, check_plant
from flytrack_sysid.check.fix import fix_mapping
from flytrack_sysid.log import FlightLog, median_step

LINES = RESULTS / "check.jsonl"
Part = Literal["clean", "faults", "fixes", "pairs", "simulators", "measured"]
PARTS: tuple[Part, ...] = get_args(Part)
OUTCOMES = ("exact", "partial", "unexplained", "false", "missed")
FIXED = ("equal", "ambiguous", "left", "wrong", "missed")
MAX_ALTERNATIVES = 4
SCALE_TOLERANCE, DELAY_TOLERANCE, DELAY_TOLERANCE_S = 0.05, 0.1, 0.003
COMMAND_TOLERANCE_S = 0.02  # the lag of the craft is not known better
FRACTION_TOLERANCE = 0.2  # of the fraction of repeated rows
LOGS_A_FAULT = 0.1  # of the number of clean logs
# Faults that are words of a mapping: units, signs, order of columns, frames, ends of commands.
FIXABLE = [
    name
    for name in FAULTS
    if name in UNITS
    or name.endswith((" sign", " swapped", " frame"))
    or name in ("q order", "q conjugate", "q body", "q world", "all NED and FRD")
    or name in ("u_thrust 0..1", "u_thrust upside down")  # an import refuses PWM
]


class Trial(NamedTuple):
    """What is checked.

    Attributes:
        part: of ``PARTS``.
        name: of the fault or the simulator, "" otherwise.
        number: of the flight.
        seed: of flights and faults.
        model: whether the check is given the craft's full rates and lags.
    """

    part: Part
    name: str
    number: int
    seed: int
    model: bool


@lru_cache(1)
def cached_flight(seed: int, number: int) -> Flight:
    """Return a flight; trials of a number follow each other."""
    return make_flight(100_000 * seed + number)


def measure(trial: Trial) -> Line:
    """Check a log or a plant and compare what is found with the truth."""
    if trial.part == "measured":
        log = measured_flights()[trial.name].log
        return {"truth": [], "shown": True, **compare(check_log(log), ())}
    if trial.part == "simulators":
        simulator = next(one for one in SIMULATORS if one.name == trial.name)
        check = check_plant(simulator.step, simulator.layout)
        result = {"shown": True, **compare(check, simulator.expected)}
        return {"truth": sorted(simulator.expected), **result}
    flight = cached_flight(trial.seed, trial.number)
    rng = np.random.default_rng([trial.seed, trial.number, crc32(trial.name.encode())])
    dt, name, truth = median_step(flight.log), trial.name, Truth()
    if trial.part in ("faults", "fixes"):
        truth = FAULTS[name](rng, dt)
    elif trial.part == "pairs":
        name, truth = draw_pair(rng, dt)
    faulty, craft, model = inject(rng, flight, truth), flight.craft, None
    if trial.model:
        model = nominal_parameters()._replace(
            max_rate=np.array(craft.max_rate), tau=np.array(craft.lags)
        )
    result = {"kind": flight.kind, "faults": name, "shown": is_shown(flight, truth)}
    if trial.part == "fixes":
        return {"truth": sorted(truth), **result, **fix_and_compare(faulty.log, flight.log, model)}
    check = check_log(faulty.log, model, faulty.motors)
    return {"truth": sorted(truth), **result, **compare(check, truth)}


def fix_and_compare(faulty: FlightLog, right: FlightLog, model: ModelParameters | None) -> Line:
    """Import a faulty log by a mapping that takes it as it is, correct the mapping, import again.

    Returns:
        alternatives, and the outcome: "equal" if the mapping corrected by one of at most four
        alternatives reads the right log; "ambiguous" if there are several that do not, of which
        only what they share is written; "left" if no word of a mapping says some of the changes;
        "wrong" if the corrected mapping reads another log; "missed" if nothing was found.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / "flight.csv"
        write_csv(path, faulty)
        check = check_log(import_csv(path, MAPPING), model)
        alternatives = [changes for changes in check.explanations if changes]
        fixes = [fix_mapping(MAPPING, changes) for changes in alternatives[:MAX_ALTERNATIVES]]
        if any(not fix.left and is_equal(import_csv(path, fix.text), right) for fix in fixes):
            outcome = "equal"
        else:
            outcome = "missed" if not fixes else "left" if fixes[0].left else "wrong"
            outcome = "ambiguous" if len(fixes) > 1 else outcome
    return {"alternatives": [tuple(one) for one in alternatives], "outcome": outcome}


def compare(check: Any, truth: Iterable[Change]) -> Line:
    """Compare a check with the truth.

    Returns:
        Names of contradicted pairs, alternatives, and the outcome: "exact" if one of at most four
        alternatives is the truth; "partial" if one has only true changes, or if more than four
        have the truth among them; "unexplained" if there is a contradiction without alternatives;
        "false"; "missed" if there is neither.
    """
    contradicted = [pair.name for pair in check.pairs if pair.verdict == "contradicts"]
    alternatives = [tuple(changes) for changes in check.explanations if changes]
    true_changes = tuple(truth)
    only_true = [
        changes
        for changes in alternatives
        if all(any(is_same(change, true) for true in true_changes) for change in changes)
    ]
    if not alternatives:
        outcome = "unexplained" if contradicted else "missed" if true_changes else "exact"
    elif not only_true:
        outcome = "false"
    elif len(alternatives) <= MAX_ALTERNATIVES and len(true_changes) in map(len, only_true):
        outcome = "exact"
    else:
        outcome = "partial"
    return {"contradicted": contradicted, "alternatives": alternatives, "outcome": outcome}


def is_same(change: Any, true: Change) -> bool:
    """Return whether a change is a true one, within tolerances."""
    if (change.channel, change.kind) != (true.channel, true.kind):
        return False
    if isinstance(true.value, str | bool):
        return bool(change.value == true.value)
    tolerance = {
        "scale": SCALE_TOLERANCE * abs(true.value),
        "delay": max(
            DELAY_TOLERANCE * abs(true.value),
            COMMAND_TOLERANCE_S if true.channel == "u" else DELAY_TOLERANCE_S,
        ),
        "repeated": FRACTION_TOLERANCE * true.value,
    }.get(true.kind, 0.0)
    return abs(float(change.value) - true.value) <= tolerance


def plan_trials(parts: Iterable[Part], logs: int, seed: int, model: bool) -> list[Trial]:
    """Return the trials; those of a flight follow each other."""
    trials = []
    for number in range(logs):
        if "clean" in parts:
            trials.append(Trial("clean", "", number, seed, model))
        if "pairs" in parts:
            trials.append(Trial("pairs", "", number, seed, model))
        if "faults" in parts and number < LOGS_A_FAULT * logs:
            trials += [Trial("faults", name, number, seed, model) for name in FAULTS]
        if "fixes" in parts and number < LOGS_A_FAULT * logs:
            trials += [Trial("fixes", name, number, seed, model) for name in FIXABLE]
    if "simulators" in parts:
        trials += [Trial("simulators", simulator.name, 0, seed, False) for simulator in SIMULATORS]
    if "measured" in parts:
        trials += [Trial("measured", name, 0, seed, False) for name in measured_flights()]
    return trials


def count_outcomes(name: str, lines: list[Line], kinds: Sequence[str], wrong: str) -> list[Any]:
    """Return a row of the page: how often each outcome was, of the faults that motion shows.

    Args:
        name: of the row.
        lines: of it.
        kinds: of outcomes.
        wrong: outcome that is counted where the motion does not show the fault.
    """
    count = Counter(line["outcome"] for line in lines if line["shown"])
    hidden = [line["outcome"] for line in lines if not line["shown"]]
    counts = [count[kind] for kind in kinds]
    return [name, count.total(), *counts, f"{hidden.count(wrong)} of {len(hidden)}"]


def outcome_columns(first: str, kinds: Sequence[str], wrong: str) -> list[str]:
    """Return the names of the columns of ``count_outcomes``."""
    return [first, "shown", *kinds, f"{wrong} where not shown"]


def faults_table(
    lines: list[Line], names: Iterable[str], kinds: Sequence[str], wrong: str
) -> tuple[str, int]:
    """Return a table of faults, and the number of those that it leaves out.

    It leaves out faults that logs show and that are right on each of these logs.
    """
    rows = [count_outcomes(name, select(lines, name=name), kinds, wrong) for name in names]
    imperfect = [row for row in rows if row[1] == 0 or row[1] != row[2]]
    of_all = count_outcomes("all", lines, kinds, wrong)
    columns = outcome_columns("fault", kinds, wrong)
    return table(columns, [*imperfect, of_all]), len(rows) - len(imperfect)


def describe(changes: Iterable[Iterable[Any]]) -> str:
    """Return changes as text."""
    return "; ".join(" ".join(map(str, change)) for change in changes) or "none"


def write_page() -> None:
    """Write docs/results/check.md from the lines of the last commit."""
    lines = lines_of_commit(LINES)
    done = good_lines(lines)
    by_part = {part: select(done, part=part) for part in PARTS}
    clean = []
    for kind in [*sorted({line["kind"] for line in by_part["clean"]}), "all"]:
        flown = by_part["clean"] if kind == "all" else select(by_part["clean"], kind=kind)
        wrong = [line for line in flown if line["contradicted"] or line["alternatives"]]
        changes = Counter(
            f"{channel} {kind}"
            for line in wrong
            for channel, kind, _ in (line["alternatives"] or [[]])[0]
        )
        named = ", ".join(f"{name} ({count})" for name, count in changes.most_common())
        bound = ""
        if flown:  # one-sided, by Clopper and Pearson
            interval = binomtest(len(wrong), len(flown), alternative="less").proportion_ci(0.95)
            bound = f"{100.0 * interval.high:.1f} %"
        clean.append([kind, len(flown), len(wrong), bound, named])
    faults, num_exact = faults_table(by_part["faults"], FAULTS, OUTCOMES, "false")
    fixes, num_equal = faults_table(by_part["fixes"], FIXABLE, FIXED, "wrong")
    pairs = [
        count_outcomes(
            name,
            [line for line in by_part["pairs"] if is_on_one(line) in kinds],
            OUTCOMES,
            "false",
        )
        for name, kinds in (
            ("on one channel", {True}),
            ("on two channels", {False}),
            ("all", {True, False}),
        )
    ]
    folders = Counter(dataset_name(line) for line in by_part["measured"])
    contradicted = Counter(
        dataset_name(line) for line in by_part["measured"] if line["outcome"] != "exact"
    )
    simulators = [
        [
            line["name"],
            describe(line["truth"]),
            line["outcome"] if line["truth"] or line["contradicted"] else "no contradiction",
        ]
        for line in by_part["simulators"]
    ]
    fill_page(
        RESULTS / "check.md",
        "check",
        measured=table(
            "folder | logs | contradicted",
            [[folder, count, contradicted[folder]] for folder, count in folders.items()],
        ),
        clean=table("flight | logs | contradicted | 95 % upper bound | what", clean),
        faults=faults,
        fixes=fixes,
        num_exact=num_exact,
        num_equal=num_equal,
        pairs=table(outcome_columns("two faults", OUTCOMES, "false"), pairs),
        simulators=table("simulator | expected | outcome", simulators),
        errors=len(lines) - len(done),
        commit=lines[-1]["commit"],
        seconds=", ".join(f"{seconds:.1f}" for seconds in cpu_seconds()),
        seeds=", ".join(sorted({str(line["seed"]) for line in lines})),
        model="with" if any(line["model"] for line in lines) else "without",
    )


def cpu_seconds() -> list[float]:
    """Return the CPU seconds of checks of a flight, clean and with its gyroscope in FRD, twice."""
    flight = make_flight(100_000 * 53)
    frd = Truth({Change("w", "axes", "x -y -z")})
    logs = [flight.log, inject(np.random.default_rng(0), flight, frd).log]
    seconds = []
    for log in logs * 2:
        start = process_time()
        check_log(log)
        seconds.append(process_time() - start)
    return seconds


def dataset_name(line: Line) -> str:
    """Return the folder of a measured flight."""
    return str(line["name"].partition("/")[0])


def is_on_one(line: Line) -> bool:
    """Return whether both faults of a line are on one channel."""
    return len({channel.split("_")[0] for channel, *_ in line["truth"]}) == 1


def main(
    logs: int = 200,
    part: Part | None = None,
    seed: int = 53,
    model: bool = False,
    page: bool = False,
    jobs: JobFlags = IN_THIS_PROCESS,
) -> None:
    """Check logs and plants.

    Args:
        logs: clean ones and ones with two faults; each single fault is on a tenth of them.
        part: only this one.
        seed: of flights and faults; 7 is for development.
        model: give the check the craft's full rates and lags.
        page: write the page from the lines instead.
    """
    if page:
        write_page()
        return
    record_trials(
        LINES,
        plan_trials(PARTS if part is None else (part,), logs, seed, model),
        measure,
        jobs=jobs,
    )


if __name__ == "__main__":
    command(main)
