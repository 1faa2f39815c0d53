"""docs/results/diagnosis.md, from the lines that ``benchmarks.diagnosis`` wrote.

``python -m benchmarks.diagnosis_page`` takes those of the last commit.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np

from benchmarks.diagnosis import LINES, ROWS, Trial, read_lines
from benchmarks.hidden import MOTIONS
from benchmarks.report import Figure, figures_table, fill_page, share, table

Line = dict[str, Any]
Rows = dict[str, list[Line]]
CONTROLS = ("clean", "heavy", "coloured", "gusts")
SHOWN, SEPARATE, HIDDEN = 30.0, 20.0, 8.0  # lambda
NOTABLE = 0.2  # of the noise: error that a new flight shows
# The plants have other laws for these (flytrack_bench/hidden), so that their parameters differ.
OTHER_LAW = ("translational_lift", "rate_saturation", "ground_effect")
USUAL_RATE, CLOCK, CLOCK_WITHIN_S = 100, "mocap_latency", 0.002
ONSET_WITHIN_S = 1.0
VISIBLE = 10.0  # standard deviations of an effect outside the list: it was there, and flown


def named(line: Line) -> list[str]:
    """Return the names that a line gives."""
    return [cause["effect"] for cause in line["causes"]]


def found(line: Line) -> list[dict[str, Any]]:
    """Return the causes that a line names, and true ones that it lists as too small to matter."""
    return line["causes"] + [one for one in line["negligible"] if one["effect"] in line["effects"]]


def classes(line: Line) -> list[set[str]]:
    """Return the names of each cause found with those that cannot be told from it."""
    return [{cause["effect"], *cause["equivalent"]} for cause in found(line)]


def is_exact(line: Line) -> bool:
    """Return whether a line finds all effects of its plant and names no other."""
    return sorted(cause["effect"] for cause in found(line)) == sorted(line["effects"])


def is_clear(line: Line) -> bool:
    """Return whether all effects of a plant are shown and separable."""
    sizes = [line["known"].get(effect, (0.0, 0.0)) for effect in line["effects"]]
    return all(size[0] > SHOWN and size[1] > SEPARATE for size in sizes)


def exact_sets(lines: Iterable[Line]) -> list[bool]:
    """Return whether exactly the true effects are named, for plants whose effects are clear.

    Effects are clear if all of them are shown and separable.
    """
    return [is_exact(line) for line in lines if is_clear(line)]


def covered(lines: Iterable[Line]) -> list[bool]:
    """Return whether intervals cover the truth, of named parameters that have one."""
    return [
        low <= true <= high
        for line in lines
        for cause in found(line)
        if cause["effect"] not in OTHER_LAW
        for true, _, low, high in cause["intervals"].values()
    ]


def percentiles(values: list[float], *which: int, unit: str = "") -> str:
    """Return percentiles of values as text; "none" of no values."""
    return ", ".join(f"{np.percentile(values, q):.1f}{unit}" for q in which) if values else "none"


def is_clock_right(line: Line) -> bool:
    """Return whether a late motion capture is found within 2 ms, and nothing else is named."""
    true_s, found_s = line["late_s"]
    return set(named(line)) <= {CLOCK} and abs(found_s - true_s) <= CLOCK_WITHIN_S


def is_onset_right(line: Line) -> bool:
    """Return whether exactly the true effect is found, and its onset within a second."""
    times = [cause.get("onset_s", [np.inf])[0] for cause in found(line)]
    return is_exact(line) and all(abs(one - line["onset"]) <= ONSET_WITHIN_S for one in times)


def is_time_told(line: Line) -> bool:
    """Return whether a line says of any cause when it began or ended."""
    return any(
        "onset_s" in cause or "end_s" in cause for cause in (*line["causes"], *line["negligible"])
    )


def figures(by_row: Rows) -> list[Figure]:
    """Return the figures of plants that move in one way."""
    one = [(line, *case) for line in by_row["one"] for case in line.get("known", {}).items()]
    shown = [(line, effect, size) for line, effect, size in one if size[0] > SHOWN]
    hiding = [line for row in ("one", "two", "three") for line in by_row[row]]
    other_law = [line for line in hiding if any(effect in OTHER_LAW for effect in line["effects"])]
    same_law = [line for line in hiding if line not in other_law]
    removed = [100.0 * line["removed"][0] for line in hiding if line["removed"][1] >= NOTABLE]
    sizes = [len(names) for line in by_row["one"] for names in classes(line)]
    outside = [line for line in by_row["outside"] if line["visible"] >= VISIBLE]
    every = [line for lines in by_row.values() for line in lines]
    controls = {
        row: [bool(named(line) or line.get("beyond_the_list")) for line in by_row[row]]
        for row in CONTROLS
    }
    any_name = [flag for flags in controls.values() for flag in flags]
    others = [line for row in ROWS if row != "onset" for line in by_row[row]]
    shares = [
        ("any name on plants without an effect", "at most 1 %", any_name),
        *((f"the same, {row}", "", flags) for row, flags in controls.items()),
        (
            "something negligible on them",
            "",
            [bool(line["negligible"]) for row in CONTROLS for line in by_row[row]],
        ),
        ("detected: any name, lambda > 30", "99 %", [bool(found(line)) for line, *_ in shown]),
        ("exact name, lambda > 30 and lambda_sep > 20", "98 %", exact_sets(by_row["one"])),
        (
            "truth in the reported class, lambda > 30",
            "98 %",
            [any(effect in names for names in classes(line)) for line, effect, _ in shown],
        ),
        ("silent, lambda < 8", "", [not found(line) for line, _, size in one if size[0] < HIDDEN]),
        ("exact set of 2, each separable", "95 %", exact_sets(by_row["two"])),
        ("exact set of 3, each separable", "90 %", exact_sets(by_row["three"])),
        ("95 % intervals cover the truth", "92 to 98 %", covered(same_law)),
        ("the same, beside an effect of another law", "", covered(other_law)),
        ("outside the list: flagged", "95 %", [bool(line["unexplained"]) for line in outside]),
        (
            "outside the list: dependence named",
            "80 %",
            [any(line["depends_on"] in name for name in line["unexplained"]) for line in outside],
        ),
        ("outside the list: false name", "at most 5 %", [bool(named(line)) for line in outside]),
        (
            "motion capture 0 to 40 ms late: within 2 ms, no other name",
            "95 %",
            [is_clock_right(line) for line in by_row["clock"]],
        ),
        (
            "effect that begins in flight: exact name, onset within 1 s",
            "90 %",
            [is_onset_right(line) for line in by_row["onset"]],
        ),
        ("others: an onset or end told", "", [is_time_told(line) for line in others]),
        ("motion recognised", "", [line["is_motion_right"] for line in every]),
    ]
    cpu_s = [line["cpu_s"] for line in every]
    return [
        *(Figure(name, target, *share(flags)) for name, target, flags in shares),
        Figure(
            "mean size of a class",
            "at most 1.5",
            f"{np.mean(sizes):.2f}" if sizes else "none",
            len(sizes),
        ),
        Figure(
            "explainable error removed on a new flight: median, tenth percentile",
            "99 %, 95 %",
            percentiles(removed, 50, 10, unit=" %"),
            len(removed),
        ),
        Figure(
            "CPU seconds a log: median, 95th percentile",
            "8, 15",
            percentiles(cpu_s, 50, 95),
            len(cpu_s),
        ),
    ]


def figures_of_motions(by_trial: dict[Trial, Line]) -> str:
    """Return the figures of the usual rate, two columns a motion."""
    columns = [figures(by_row_of(by_trial, motion, USUAL_RATE)) for motion in MOTIONS]
    rows = []
    for figure, *others in zip(*columns, strict=True):
        rows.append([*figure, *(cell for other in others for cell in (other.measured, other.n))])
    return table(
        ["figure", "target", *(head for motion in MOTIONS for head in (motion, "n"))], rows
    )


def figures_of_rates(by_trial: dict[Trial, Line]) -> str:
    """Return names on clean plants and exact ones of other rates."""
    kinds = sorted({(trial.rate, trial.motion) for trial in by_trial if trial.rate != USUAL_RATE})
    rows = []
    for rate, motion in kinds:
        by_row, flown = by_row_of(by_trial, motion, rate), f"{rate} Hz, {motion}"
        is_named = [bool(named(line)) for line in by_row["clean"]]
        rows.append(Figure(f"{flown}: any name on clean plants", "at most 2 %", *share(is_named)))
        rows.append(Figure(f"{flown}: exact single", "95 %", *share(exact_sets(by_row["one"]))))
    return figures_table(rows)


def by_row_of(by_trial: dict[Trial, Line], motion: str, rate: int) -> Rows:
    """Return the lines of a motion and rate by row."""
    chosen = {
        trial: line
        for trial, line in by_trial.items()
        if (trial.motion, trial.rate) == (motion, rate)
    }
    return {row: [line for trial, line in chosen.items() if trial.row == row] for row in ROWS}


def counted(header: str, pairs: Iterable[tuple[str, str]]) -> str:
    """Return a table of truths and how often each was given which name."""
    counts: dict[str, Counter[str]] = {}
    for truth, name in pairs:
        counts.setdefault(truth, Counter()).update([name])
    rows = [
        (truth, own.total(), ", ".join(f"{name} {number}" for name, number in own.most_common()))
        for truth, own in sorted(counts.items())
    ]
    return table(header, rows)


def misses(by_trial: dict[Trial, Line]) -> str:
    """Return every plant on which a name was missing or false, with what could be known."""
    rows = []
    for trial, line in sorted(by_trial.items()):
        if not is_exact(line) and named(line) != [CLOCK]:
            known = line.get("known", {}).items()
            could = ", ".join(
                f"{name} {size:.3g}, {beside:.3g}" for name, (size, beside, _) in known
            )
            flown = f"{trial.motion}, {trial.rate} Hz"
            rows.append((trial.row, flown, line["truth"], could, ", ".join(named(line)) or "none"))
    return table("row | flown | truth | lambda, lambda_sep | named", rows)


def main() -> None:
    """Write the page."""
    lines = list(read_lines(None).values())
    by_trial = {trial: line for trial, line in read_lines(None).items() if "error" not in line}
    by_row = {row: [line for trial, line in by_trial.items() if trial.row == row] for row in ROWS}
    singles = [
        (line["effects"][0], " + ".join(sorted(named(line))) or "none") for line in by_row["one"]
    ]
    outside = []
    for line in by_row["outside"]:
        if line["visible"] >= VISIBLE:
            seen = {name.split(": ")[1].split(" at ")[0] for name in line["unexplained"]}
            outside.append((line["depends_on"], " + ".join(sorted(seen)) or "none"))
    fill_page(
        LINES.with_suffix(".md"),
        "diagnosis",
        plants=", ".join(f"{row} {len(by_row[row])}" for row in ROWS),
        crashed=len(lines) - len(by_trial),
        seeds=sorted({line["seed"] for line in lines}),
        commits=", ".join(sorted({f"{line['commit']} of {line['date']}" for line in lines})),
        machines="; ".join(sorted({line["machine"] for line in lines})),
        visible=VISIBLE,
        figures=figures_of_motions(by_trial),
        rates=figures_of_rates(by_trial),
        singles=counted("truth | plants | named", singles),
        outside=counted("depends on | plants | found", outside),
        misses=misses(by_trial),
    )


if __name__ == "__main__":
    main()
