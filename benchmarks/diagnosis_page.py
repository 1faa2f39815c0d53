"""docs/results/diagnosis.md, of the lines that ``benchmarks.diagnosis`` wrote."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from benchmarks.diagnosis import LINES, ROWS, read_lines
from flytrack_env.files import write_atomically

PAGE = LINES.with_suffix(".md")
Line = dict[str, Any]
CONTROLS = ("clean", "heavy", "coloured", "gusts")
SHOWN, SEPARATE, HIDDEN = 30.0, 20.0, 8.0  # lambda
NOTABLE = 0.2  # of the noise: error that a new flight shows
# Whose parameters are those of another law: the plants have laws of their own (benchmarks/hidden).
OTHER_LAW = ("translational_lift", "rate_saturation", "ground_effect")
VISIBLE = 10.0  # standard deviations of an effect outside the list: it was there, and flown


def percent(values: Sequence[bool | int]) -> str:
    """Return a share and its count as text."""
    return f"{100.0 * np.mean(values):.1f} % of {len(values)}" if len(values) else "none"


def named(line: Line) -> list[str]:
    """Return the names that a line gives."""
    return [cause["effect"] for cause in line["causes"]]


def classes(line: Line) -> list[set[str]]:
    """Return the names of each cause with those that cannot be told from it."""
    return [{cause["effect"], *cause["equivalent"]} for cause in line["causes"]]


def singles(lines: Iterable[Line]) -> list[tuple[Line, str, float, float]]:
    """Return lines of one hidden effect that has a lambda: line, effect, lambda, lambda_sep."""
    found = []
    for line in lines:
        for effect, (size, beside, _) in line.get("known", {}).items():
            found.append((line, effect, size, beside))
    return found


def is_named(line: Line, effect: str) -> bool:
    """Return whether the class of a cause has an effect."""
    return any(effect in one for one in classes(line))


def exact_sets(lines: Iterable[Line]) -> list[bool]:
    """Return, of plants all of whose effects are shown and separable, whether exactly they are named."""
    found = []
    for line in lines:
        could = line["known"]
        if all(
            effect in could and could[effect][0] > SHOWN and could[effect][1] > SEPARATE
            for effect in line["effects"]
        ):
            found.append(sorted(named(line)) == sorted(line["effects"]))
    return found


def has_other_law(line: Line) -> bool:
    """Return whether a plant hides an effect whose law is not the package's."""
    return any(effect in OTHER_LAW for effect in line["effects"])


def covered(line: Line) -> list[bool]:
    """Return whether intervals cover the truth, of named parameters that have one."""
    return [
        low <= true <= high
        for cause in line["causes"]
        if cause["effect"] not in OTHER_LAW
        for true, _, low, high in cause["intervals"].values()
    ]


def figures(by_row: dict[str, list[Line]]) -> list[tuple[str, str, str]]:
    """Return the issue's figures: what, at least, measured."""
    one = singles(by_row["one"])
    shown = [case for case in one if case[2] > SHOWN]
    separate = [case for case in shown if case[3] > SEPARATE]
    hidden = [case for case in one if case[2] < HIDDEN]
    controls = [bool(named(line)) for row in CONTROLS for line in by_row[row]]
    sizes = [len(one) for line in by_row["one"] for one in classes(line)]
    removed = [
        line["removed"][0]
        for row in ("one", "two", "three")
        for line in by_row[row]
        if line["removed"][1] >= NOTABLE
    ]
    hiding = [line for row in ("one", "two", "three") for line in by_row[row]]
    covers = [value for line in hiding if not has_other_law(line) for value in covered(line)]
    beside = [value for line in hiding if has_other_law(line) for value in covered(line)]
    outside = [line for line in by_row["outside"] if line["visible"] >= VISIBLE]
    seconds = [line["cpu_s"] for lines in by_row.values() for line in lines]
    return [
        ("any name on plants without an effect", "at most 1 %", percent(controls)),
        *((f"the same, {row}", "", percent([bool(named(line)) for line in by_row[row]])) for row in CONTROLS),
        ("detected: any name, lambda > 30", "99 %", percent([bool(named(case[0])) for case in shown])),
        (
            "exact name, lambda > 30 and lambda_sep > 20",
            "98 %",
            percent([named(case[0]) == [case[1]] for case in separate]),
        ),
        (
            "truth in the reported class, lambda > 30",
            "98 %",
            percent([is_named(case[0], case[1]) for case in shown]),
        ),
        ("mean size of a class", "at most 1.5", f"{np.mean(sizes):.2f}" if sizes else "none"),
        ("silent, lambda < 8", "", percent([not named(case[0]) for case in hidden])),
        ("exact set of 2, each separable", "95 %", percent(exact_sets(by_row["two"]))),
        ("exact set of 3, each separable", "90 %", percent(exact_sets(by_row["three"]))),
        (
            "explainable error removed on a new flight: median, tenth percentile",
            "99 %, 95 %",
            ", ".join(f"{100 * np.percentile(removed, q):.1f} %" for q in (50, 10)) + f" of {len(removed)}"
            if removed
            else "none",
        ),
        ("95 % intervals cover the truth", "92 to 98 %", percent(covers)),
        ("the same, beside an effect of another law", "", percent(beside)),
        ("outside the list: flagged", "95 %", percent([bool(line["unexplained"]) for line in outside])),
        ("outside the list: dependence named", "80 %", percent([is_dependence(line) for line in outside])),
        ("outside the list: false name", "at most 5 %", percent([bool(named(line)) for line in outside])),
        (
            "CPU seconds a log: median, 95th percentile",
            "at most 10",
            f"{np.median(seconds):.1f}, {np.percentile(seconds, 95):.1f}" if seconds else "none",
        ),
    ]


def is_dependence(line: Line) -> bool:
    """Return whether what an effect outside the list depends on is named."""
    return any(line["depends_on"] in name for name in line["unexplained"])


def confusion(lines: Iterable[Line]) -> str:
    """Return the confusion matrix of single effects as Markdown, what is never confused left out."""
    counts: dict[str, Counter[str]] = {}
    for line in lines:
        truth = line["effects"][0]
        counts.setdefault(truth, Counter()).update([" + ".join(sorted(named(line))) or "none"])
    rows = ["| truth | plants | named |", "|---|---|---|"]
    for truth in sorted(counts):
        said = ", ".join(f"{name} {count}" for name, count in counts[truth].most_common())
        rows.append(f"| {truth} | {sum(counts[truth].values())} | {said} |")
    return "\n".join(rows)


def misses(by_row: dict[str, list[Line]]) -> str:
    """Return every plant on which a name was missing or false, as Markdown, with what could be known."""
    rows = ["| row | truth | lambda, lambda_sep | named |", "|---|---|---|---|"]
    for row in ROWS:
        for line in by_row[row]:
            if sorted(named(line)) == sorted(line["effects"]):
                continue
            could = ", ".join(
                f"{name} {size:.3g}, {beside:.3g}"
                for name, (size, beside, _) in line.get("known", {}).items()
            )
            said = ", ".join(named(line)) or "none"
            rows.append(f"| {row} | {line['truth']} | {could} | {said} |")
    return "\n".join(rows)


def dependences(lines: Iterable[Line]) -> str:
    """Return what was said of effects outside the list, by kind, as Markdown."""
    counts: dict[str, Counter[str]] = {}
    for line in lines:
        if line["visible"] < VISIBLE:
            continue
        said = sorted({name.split(": ")[1].split(" at ")[0] for name in line["unexplained"]})
        counts.setdefault(line["depends_on"], Counter()).update([" + ".join(said) or "none"])
    rows = ["| depends on | plants | said |", "|---|---|---|"]
    for kind in sorted(counts):
        said = ", ".join(f"{name} {count}" for name, count in counts[kind].most_common())
        rows.append(f"| {kind} | {sum(counts[kind].values())} | {said} |")
    return "\n".join(rows)


def page() -> str:
    """Return the page."""
    lines = list(read_lines(None).values())
    crashed = [line for line in lines if "error" in line]
    by_row = {row: [line for line in lines if line["row"] == row and "error" not in line] for row in ROWS}
    table = ["| figure | aim | measured |", "|---|---|---|"]
    table += [f"| {what} | {aim} | {value} |" for what, aim, value in figures(by_row)]
    commits = sorted({f"{line['commit']} of {line['date']}" for line in lines})
    machines = sorted({line["machine"] for line in lines})
    counts = ", ".join(f"{row} {len(by_row[row])}" for row in ROWS)
    return f"""# How well hidden effects are named

Written by `python -m benchmarks.diagnosis --write` of the lines that `python -m benchmarks.diagnosis` wrote
to docs/results/diagnosis.jsonl, a line a plant. Plants: {counts}; crashed: {len(crashed)}.
Seeds {sorted({line["seed"] for line in lines})}; measured at {", ".join(commits)}; {"; ".join(machines)}.

Every plant is flown for 60 s (benchmarks/hidden: other equations than the simulator's, some of another
form), and measured: gyro 0.1 rad/s, accelerometer 1.5 m/s^2, velocity 0.05 m/s, attitude 0.5 degrees,
quantised, 2 % of rows lost. The diagnosis sees the log and the model without the hidden effects; a quarter
of the log is held out. `lambda` is what the other three quarters could show of an effect, `lambda_sep` what
is left of it beside its closest rival, both from the truth (benchmarks/hidden/oracle.py). An effect outside
the list counts where it changes its channel by {VISIBLE:g} standard deviations or more over the log.

{chr(10).join(table)}

## Single effects

{confusion(by_row["one"])}

## Effects outside the list

{dependences(by_row["outside"])}

## Every plant with a name missing or false

{misses(by_row)}
"""


def write_page() -> None:
    """Write the page."""
    write_atomically(PAGE, page().encode())
    print(page())
