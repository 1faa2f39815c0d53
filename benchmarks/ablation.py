"""Ablation of the rules of the diagnosis: ``python -m benchmarks.ablation``.

First it diagnoses plants (those of ``benchmarks.diagnosis``, flown for half a minute), or measured
flights, and records which rules fire. Then it diagnoses each again without one rule at a time, for
the rules that fired on it; a rule that did not fire changes nothing. Results are appended to
docs/results/ablation.jsonl, and a later run resumes there; ``--page`` writes
docs/results/ablation.md from them.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache, wraps
from itertools import product
from types import ModuleType
from typing import Any, NamedTuple
from unittest.mock import patch

from benchmarks import hidden
from benchmarks.diagnosis import ROWS, Trial, make_log
from benchmarks.report import (
    RESULTS,
    Line,
    append_line,
    command,
    commit_of_checkout,
    fill_page,
    lines_in,
    progress,
    select,
    table,
)
from benchmarks.seams.measured import measured_flights
from flytrack_env.dynamics import ModelParameters
from flytrack_sysid import Imported
from flytrack_sysid.diagnosis import (
    Diagnosis,
    diagnose,
    model_selection,
    onset,
    outliers,
    size,
    summary,
    unexplained,
    vetoes,
)
from flytrack_sysid.log import FlightLog

LINES = RESULTS / "ablation.jsonl"
SECONDS, SECONDS_OF_ONSET = 30.0, 60.0
SEED = 41  # no rule was made on it
MEASURED = "measured"  # a row whose trials have the name of a flight for their motion
SHORTEST_S, FLIGHTS_OF_A_FOLDER = 15.0, 2
PACKAGE = "flytrack_sysid"


def empty(*_: Any) -> list[Any]:
    """Return an empty list, whatever the arguments."""
    return []


class Rule(NamedTuple):
    """A rule of the diagnosis, and the function that stands in for it when it is disabled.

    Attributes:
        module: that defines the rule.
        name: of the rule's function.
        disabled: takes the same arguments, and returns what the rule does where it does not fire.
    """

    module: ModuleType
    name: str
    disabled: Callable[..., Any]


RULES = (
    *(Rule(vetoes, rule.__name__, empty) for rule in vetoes.VETOES),
    Rule(model_selection, "with_lags_anew", empty),
    Rule(model_selection, "with_moving_air", empty),
    Rule(onset, "gain_of_other_dependence", lambda *_: 0.0),
    Rule(onset, "with_changes", lambda selection, *_: selection),
    Rule(summary, "causes_at_end", lambda *_: ()),
    Rule(summary, "_is_remainder", lambda *_: False),
    Rule(summary, "_as_thrust_scale", lambda cause, *_: cause),
    Rule(unexplained, "is_like_drift", lambda *_: False),
    Rule(unexplained, "find_lines", empty),
    Rule(unexplained, "stochastic_shares", lambda *_: {}),
    Rule(outliers, "find_outliers", lambda *_: {}),
    Rule(size, "is_notable", lambda *_: True),
)
BY_NAME = {rule.name: rule for rule in RULES}


def has_fired(result: Any, disabled: Any) -> bool:
    """Return whether a rule's result differs from the one it has when it is disabled."""
    if result is disabled:
        return False
    if type(disabled) is tuple:
        return len(result) != len(disabled) or (disabled != () and result[-1] is not disabled[-1])
    return not isinstance(disabled, bool | list | dict) or bool(result != disabled)


@contextmanager
def replaced(rule: Rule, function: Callable[..., Any]) -> Iterator[None]:
    """Have the package call another function in place of a rule's, wherever it is imported."""
    original = getattr(rule.module, rule.name)
    loaded = [module for name, module in sys.modules.items() if name.startswith(PACKAGE)]
    listed = tuple(function if veto is original else veto for veto in vetoes.VETOES)
    with ExitStack() as stack:
        for module in loaded:
            if getattr(module, rule.name, None) is original:
                stack.enter_context(patch.object(module, rule.name, function))
        stack.enter_context(patch.object(vetoes, "VETOES", listed))
        yield


def outcome(diagnosis: Diagnosis) -> Line:
    """Return what is compared: verdict, causes with their equivalents, and what is unexplained."""
    return {
        "verdict": diagnosis.verdict,
        "causes": {cause.effect: sorted(cause.equivalent) for cause in diagnosis.causes},
        "negligible": sorted(cause.effect for cause in diagnosis.negligible),
        "beyond": sorted(cause.effect for cause in diagnosis.beyond),
        "unexplained": sorted(diagnosis.unexplained.shares),
    }


def flown(trial: Trial) -> tuple[list[str], FlightLog, ModelParameters]:
    """Return the names of a plant's effects, its flight, and its team's model."""
    if trial.row == MEASURED:
        flight = measured()[trial.motion]
        return [], flight.log, flight.nominal_model()
    truth, _, log, model, _ = make_log(trial, SECONDS_OF_ONSET if trial.row == "onset" else SECONDS)
    return sorted(truth.effects) + ["mocap_latency"] * (truth.mocap_late_s > 0.0), log, model


@cache
def measured() -> dict[str, Imported]:
    """Return measured flights that have a nominal model, by name, at most two of a folder."""
    chosen: dict[str, Imported] = {}
    for name, flight in measured_flights().items():
        others = [one for one in chosen if one.partition("/")[0] == name.partition("/")[0]]
        duration_s = flight.log.time[-1] - flight.log.time[0]
        is_known = None not in (
            flight.craft.mass_kg,
            flight.craft.max_rate_deg_s,
            flight.craft.voltage_v,
        )
        if is_known and duration_s > SHORTEST_S and len(others) < FLIGHTS_OF_A_FOLDER:
            chosen[name] = flight
    return chosen


def census(trial: Trial) -> Line:
    """Return the outcome on a plant, and how often each rule fired."""
    names, log, model = flown(trial)
    fired: Counter[str] = Counter()

    def watched(rule: Rule) -> Callable[..., Any]:
        original = getattr(rule.module, rule.name)

        @wraps(original)
        def call(*args: Any) -> Any:
            result = original(*args)
            fired[rule.name] += has_fired(result, rule.disabled(*args))
            return result

        return call

    with ExitStack() as stack:
        for rule in RULES:
            stack.enter_context(replaced(rule, watched(rule)))
        result = outcome(diagnose(log, model))
    return {"truth": names, "fired": +fired, "outcome": result}


def without(trial: Trial, name: str) -> Line:
    """Return the outcome on a plant without a rule."""
    _, log, model = flown(trial)
    with replaced(BY_NAME[name], BY_NAME[name].disabled):
        return {"outcome": outcome(diagnose(log, model))}


def score(line: Line, truth: list[str]) -> int:
    """Return the number of true effects named minus the number of false ones.

    A cause with a true effect among its equivalents is true.
    """
    causes = line["outcome"]["causes"]
    classes = [{name, *equivalent} for name, equivalent in causes.items()]
    num_false = sum(names.isdisjoint(truth) for names in classes)
    return len(set().union(*classes).intersection(truth)) - num_false


def trial_key(line: Line) -> tuple[Any, ...]:
    """Return the fields of a line that identify its plant."""
    return tuple(line[field] for field in Trial._fields)


def measure(trials: list[Trial]) -> None:
    """Append the missing lines: first with all rules, then without one rule at a time."""
    lines, commit = lines_in(LINES), {"commit": commit_of_checkout()}
    counted = {trial_key(line): line for line in select(lines, without="")}
    for trial in progress([one for one in trials if tuple(one) not in counted], "plants"):
        counted[tuple(trial)] = {**trial._asdict(), **commit, "without": "", **census(trial)}
        append_line(LINES, counted[tuple(trial)])
    done = {(trial_key(line), line["without"]) for line in lines}
    missing = [
        (trial, name)
        for trial, name in product(trials, BY_NAME)
        if name in counted[tuple(trial)]["fired"] and (tuple(trial), name) not in done
    ]
    for trial, name in progress(missing, "plants without a rule"):
        append_line(LINES, {**trial._asdict(), **commit, "without": name, **without(trial, name)})


def write_page() -> None:
    """Write docs/results/ablation.md from the lines."""
    lines = lines_in(LINES)
    flights = select(lines, row=MEASURED)
    plants = [line for line in lines if line["row"] != MEASURED]
    rules = count_by_rule(plants)
    fill_page(
        RESULTS / "ablation.md",
        "ablation",
        plants=count_whole(plants),
        commits=", ".join(sorted({line["commit"] for line in lines})),
        seconds=f"{SECONDS:g}",
        seed=SEED,
        table=table(
            "rule | plants on which it fires | outcomes that differ without it | "
            "score lower without it | score higher",
            [row for row in rules if row[1]],
        ),
        silent=", ".join(row[0] for row in rules if not row[1]),
        flights=count_whole(flights),
        shortest=f"{SHORTEST_S:g}",
        measured=", ".join(f"{row[0]} {row[1]}" for row in count_by_rule(flights) if row[1]),
    )


def count_whole(lines: list[Line]) -> int:
    """Return the number of plants or flights that were diagnosed with all rules."""
    return len(select(lines, without=""))


def count_by_rule(lines: list[Line]) -> list[list[Any]]:
    """Return for each rule how often it fires, and what differs without it."""
    counted = {trial_key(line): line for line in select(lines, without="")}
    rows = []
    for rule in RULES:
        fired = [plant for plant, line in counted.items() if rule.name in line["fired"]]
        removed = select(lines, without=rule.name)
        pairs = [(line, counted[trial_key(line)]) for line in removed]
        changed = [(line, whole) for line, whole in pairs if line["outcome"] != whole["outcome"]]
        gains = [
            score(line, whole["truth"]) - score(whole, whole["truth"]) for line, whole in changed
        ]
        share = f"{len(changed)} of {len(removed)}"
        lower, higher = sum(gain < 0 for gain in gains), sum(gain > 0 for gain in gains)
        rows.append([f"`{rule.name}`", len(fired), share, lower, higher])
    return rows


def main(
    plants: int = 10,
    rows: str = ",".join(ROWS),
    page: bool = False,
) -> None:
    """Diagnose plants with all rules, and without one rule at a time.

    Args:
        plants: of each row and motion, up to this number.
        rows: kinds of plants, or "measured" for measured flights.
        page: write the page from the lines instead.
    """
    if page:
        write_page()
        return
    if rows == MEASURED:
        measure([Trial(MEASURED, 0, SEED, name) for name in measured()])
        return
    every = product(range(plants), rows.split(","), hidden.MOTIONS)
    measure([Trial(row, number, SEED, motion) for number, row, motion in every])


if __name__ == "__main__":
    command(main)
