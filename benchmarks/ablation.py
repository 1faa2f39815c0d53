"""What each rule of the diagnosis changes: ``python -m benchmarks.ablation``.

A census diagnoses plants (those of ``benchmarks.diagnosis``, flown for half a minute) and notes
which rules did something. Then every plant is diagnosed again without each rule that did something
on it, one at a time; elsewhere a rule changes nothing. Lines go to docs/results/ablation.jsonl and
are resumed; ``--page`` writes docs/results/ablation.md from them.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from itertools import product
from typing import Any, NamedTuple

from benchmarks import hidden
from benchmarks.diagnosis import ROWS, Trial, make_log
from benchmarks.report import (
    RESULTS,
    append_line,
    command,
    commit_of_checkout,
    fill_page,
    lines_in,
    progress,
    table,
)
from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.diagnosis import (
    Diagnosis,
    diagnose,
    model_selection,
    onset,
    outliers,
    refinement,
    size,
    summary,
    unexplained,
    vetoes,
)
from flytrack_sysid.log import FlightLog

LINES = RESULTS / "ablation.jsonl"
SECONDS, SECONDS_OF_ONSET = 30.0, 60.0
SEED = 41  # no rule was made on it
PACKAGE = "flytrack_sysid"


def none_of(*_: Any) -> list[Any]:
    """Return what a rule returns that finds nothing."""
    return []


class Rule(NamedTuple):
    """A rule: a function of the diagnosis, and what it would return if it did nothing.

    Attributes:
        owner: the module or class that defines the function.
        name: of the function.
        idle: returns what the function returns where it does nothing, from its arguments.
    """

    owner: Any
    name: str
    idle: Callable[..., Any]


RULES = (
    *(Rule(vetoes, rule.__name__, none_of) for rules in vetoes.VETOES for rule in rules),
    Rule(model_selection, "with_lags_anew", none_of),
    Rule(model_selection, "other_groups", none_of),
    Rule(model_selection, "explain_base_by_effect", lambda state, *_: (state, None)),
    Rule(model_selection, "is_determined", lambda *_: True),
    Rule(model_selection, "_is_immaterial", lambda *_: False),
    Rule(onset, "with_changes", lambda selection, *_: selection),
    Rule(refinement, "_flies_worse", lambda *_: False),
    Rule(summary, "causes_at_end", lambda *_: ()),
    Rule(summary, "_is_remainder", lambda *_: False),
    Rule(summary, "_as_thrust_scale", lambda cause, *_: cause),
    Rule(unexplained, "is_like_drift", lambda *_: False),
    Rule(unexplained, "find_lines", none_of),
    Rule(unexplained, "stochastic_shares", lambda *_: {}),
    Rule(outliers, "find_outliers", lambda *_: {}),
    Rule(size, "is_notable", lambda *_: True),
)
BY_NAME = {rule.name: rule for rule in RULES}


def is_idle(result: Any, idle: Any) -> bool:
    """Return whether a rule's result is that of a rule that does nothing."""
    if result is idle:
        return True
    if type(idle) is tuple:
        return len(result) == len(idle) and (not idle or result[-1] is idle[-1])
    return isinstance(idle, bool | list | dict) and bool(result == idle)


@contextmanager
def replaced(rule: Rule, function: Callable[..., Any]) -> Iterator[None]:
    """Have the package call another function in place of a rule's, wherever it is imported."""
    original = getattr(rule.owner, rule.name)
    loaded = [module for name, module in sys.modules.items() if name.startswith(PACKAGE)]
    places = [
        place for place in (rule.owner, *loaded) if getattr(place, rule.name, None) is original
    ]
    kept_vetoes = vetoes.VETOES
    for place in places:
        setattr(place, rule.name, function)
    vetoes.VETOES = tuple(
        tuple(function if one is original else one for one in rules) for rules in kept_vetoes
    )
    try:
        yield
    finally:
        vetoes.VETOES = kept_vetoes
        for place in places:
            setattr(place, rule.name, original)


def outcome(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return what a reader is told: names, what cannot be told from them, what is unexplained."""
    return {
        "verdict": diagnosis.verdict,
        "causes": {one.effect: sorted(one.equivalent) for one in diagnosis.causes},
        "negligible": sorted(one.effect for one in diagnosis.negligible),
        "beyond": sorted(one.effect for one in diagnosis.beyond),
        "unexplained": sorted(diagnosis.unexplained.shares),
    }


def flown(trial: Trial) -> tuple[hidden.Truth, FlightLog, ModelParameters]:
    """Return a plant, its flight, and its team's model."""
    truth, _, log, model, _ = make_log(trial, SECONDS_OF_ONSET if trial.row == "onset" else SECONDS)
    return truth, log, model


def census(trial: Trial) -> dict[str, Any]:
    """Return the outcome on a plant, and which rules did something, by number of times."""
    truth, log, model = flown(trial)
    acted: Counter[str] = Counter()

    def watched(rule: Rule) -> Callable[..., Any]:
        original = getattr(rule.owner, rule.name)

        @wraps(original)
        def call(*args: Any) -> Any:
            result = original(*args)
            acted[rule.name] += not is_idle(result, rule.idle(*args))
            return result

        return call

    def with_all_watched(rules: tuple[Rule, ...]) -> Diagnosis:
        if not rules:
            return diagnose(log, model)
        with replaced(rules[0], watched(rules[0])):
            return with_all_watched(rules[1:])

    result = outcome(with_all_watched(RULES))
    acted_rules = {name: number for name, number in acted.items() if number}
    return {"truth": sorted(truth.effects), "acted": acted_rules, "outcome": result}


def without(trial: Trial, name: str) -> dict[str, Any]:
    """Return the outcome on a plant without a rule."""
    _, log, model = flown(trial)
    with replaced(BY_NAME[name], BY_NAME[name].idle):
        return {"outcome": outcome(diagnose(log, model))}


def score(line: dict[str, Any], truth: list[str]) -> int:
    """Return true names less false ones; a name that cannot be told from a true one is true."""
    causes = line["outcome"]["causes"]
    false = [name for name, equivalent in causes.items() if {name, *equivalent}.isdisjoint(truth)]
    found = [
        name
        for name in truth
        if any(name in (cause, *equivalent) for cause, equivalent in causes.items())
    ]
    return len(found) - len(false)


def key(line: dict[str, Any]) -> tuple[Any, ...]:
    """Return what identifies the plant of a line."""
    return tuple(line[field] for field in Trial._fields)


def measure(trials: list[Trial]) -> None:
    """Append the lines that are missing: first of the census, then of plants without a rule."""
    lines, commit = lines_in(LINES), {"commit": commit_of_checkout()}
    counted = {key(line): line for line in lines if not line["without"]}
    for trial in progress([one for one in trials if tuple(one) not in counted], "plants"):
        counted[tuple(trial)] = {**trial._asdict(), **commit, "without": "", **census(trial)}
        append_line(LINES, counted[tuple(trial)])
    done = {(key(line), line["without"]) for line in lines}
    missing = [
        (trial, name)
        for trial, name in product(trials, BY_NAME)
        if name in counted[tuple(trial)]["acted"] and (tuple(trial), name) not in done
    ]
    for trial, name in progress(missing, "plants without a rule"):
        append_line(LINES, {**trial._asdict(), **commit, "without": name, **without(trial, name)})


def write_page() -> None:
    """Write docs/results/ablation.md from the lines."""
    lines = lines_in(LINES)
    counted = {key(line): line for line in lines if not line["without"]}
    rows = []
    for rule in RULES:
        acted = [plant for plant, line in counted.items() if rule.name in line["acted"]]
        removed = [line for line in lines if line["without"] == rule.name]
        changed = [line for line in removed if line["outcome"] != counted[key(line)]["outcome"]]
        gains = [
            score(line, counted[key(line)]["truth"])
            - score(counted[key(line)], counted[key(line)]["truth"])
            for line in changed
        ]
        rows.append(
            [
                f"`{rule.name}`",
                len(acted),
                f"{len(changed)} of {len(removed)}",
                sum(gain < 0 for gain in gains),
                sum(gain > 0 for gain in gains),
            ]
        )
    header = [
        "rule",
        "plants on which it acts",
        "outcomes that change without it, of those tried",
        "names get worse without it",
        "names get better",
    ]
    fill_page(
        RESULTS / "ablation.md",
        "ablation.md",
        plants=len(counted),
        seconds=f"{SECONDS:g}",
        seed=SEED,
        table=table(header, rows),
    )


def main(
    plants: int = 10,
    rows: str = ",".join(ROWS),
    motion: str = ",".join(hidden.MOTIONS),
    page: bool = False,
) -> None:
    """Measure what each rule changes.

    plants: of each row and motion, up to this number.
    rows: kinds of plants.
    motion: how they move.
    page: write the page from the lines instead.
    """
    if page:
        write_page()
        return
    every = product(range(plants), rows.split(","), motion.split(","))
    measure([Trial(row, number, SEED, moved) for number, row, moved in every])


if __name__ == "__main__":
    command(main)
