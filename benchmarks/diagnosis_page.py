"""docs/results/diagnosis.md, from the lines that ``benchmarks.diagnosis`` wrote.

``python -m benchmarks.diagnosis_page`` takes those of the last commit, and of others with its code.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from benchmarks.diagnosis import CODE, LINES, ROWS, Trial
from benchmarks.hidden import MOTIONS
from benchmarks.report import (
    Figure,
    Line,
    figures_table,
    fill_page,
    good_lines,
    lines_in,
    lines_of_commit,
    list_commits,
    select,
    share_figure,
    table,
)
from flytrack_bench.misspec.scores import OTHER_LAW

CONTROLS = ("clean", "heavy", "coloured", "gusts")
SHOWN, SEPARATE, HIDDEN = 30.0, 20.0, 8.0  # lambda
NOTABLE = 0.2  # of the noise: error that a new flight shows
# Seeds on which nothing had been chosen when they were flown.
KEPT_APART = (6107, 6109, 6111, 6113, 6115, 6117)
USUAL_RATE, CLOCK, CLOCK_WITHIN_S = 100, "mocap_latency", 0.002
ONSET_WITHIN_S = 1.0
VISIBLE = 10.0  # standard deviations of an effect outside the list: it was there, and flown


def names_in(line: Line) -> list[str]:
    """Return the names that a line gives."""
    return [cause["effect"] for cause in line["causes"]]


def causes_in(line: Line) -> list[Line]:
    """Return the causes that a line names, and true ones that it lists as too small to matter."""
    true = [cause for cause in line["negligible"] if cause["effect"] in line["effects"]]
    return line["causes"] + true


def classes_in(line: Line) -> list[set[str]]:
    """Return the names of each cause found with those that cannot be told from it."""
    return [{cause["effect"], *cause["equivalent"]} for cause in causes_in(line)]


def is_exact(line: Line) -> bool:
    """Return whether a line finds all effects of its plant and names no other."""
    return sorted(cause["effect"] for cause in causes_in(line)) == sorted(line["effects"])


def exact_sets(lines: Iterable[Line]) -> list[bool]:
    """Return whether exactly the true effects are named, for plants whose effects are clear.

    Effects are clear if all of them are shown and separable.
    """
    flags = []
    for line in lines:
        sizes = [line["known"].get(effect, (0.0, 0.0)) for effect in line["effects"]]
        if all(size[0] > SHOWN and size[1] > SEPARATE for size in sizes):
            flags.append(is_exact(line))
    return flags


def covered(lines: Iterable[Line]) -> list[bool]:
    """Return whether intervals cover the truth, of named parameters that have one."""
    return [
        low <= true <= high
        for line in lines
        for cause in causes_in(line)
        if cause["effect"] not in OTHER_LAW
        for true, _, low, high in cause["intervals"].values()
    ]


def percentiles(values: list[float], *which: int, unit: str = "") -> str:
    """Return percentiles of values as text; "none" of no values."""
    return ", ".join(f"{np.percentile(values, q):.1f}{unit}" for q in which) if values else "none"


def is_clock_right(line: Line) -> bool:
    """Return whether a late motion capture is found within 2 ms, and nothing else is named."""
    true_s, estimate_s = line["late_s"]
    return set(names_in(line)) <= {CLOCK} and abs(estimate_s - true_s) <= CLOCK_WITHIN_S


def is_onset_right(line: Line) -> bool:
    """Return whether exactly the true effect is found, and its onset within a second."""
    onsets_s = [cause.get("onset_s", [np.inf])[0] for cause in causes_in(line)]
    errors_s = np.abs(np.array(onsets_s) - line["onset"])
    return is_exact(line) and bool((errors_s <= ONSET_WITHIN_S).all())


def is_time_told(line: Line) -> bool:
    """Return whether a line says of any cause when it began or ended."""
    return any({"onset_s", "end_s"} & {*cause} for cause in line["causes"] + line["negligible"])


def figures(lines: list[Line]) -> list[Figure]:
    """Return the figures of plants that move in one way."""
    by_row = {row: select(lines, row=row) for row in ROWS}
    singles = [(line, *case) for line in by_row["one"] for case in line.get("known", {}).items()]
    shown = [(line, effect) for line, effect, size in singles if size[0] > SHOWN]
    invisible = [line for line, _, size in singles if size[0] < HIDDEN]
    hiding = [line for row in ("one", "two", "three") for line in by_row[row]]
    other_law = [line for line in hiding if any(effect in OTHER_LAW for effect in line["effects"])]
    same_law = [line for line in hiding if line not in other_law]
    removed = [100.0 * line["removed"][0] for line in hiding if line["removed"][1] >= NOTABLE]
    sizes = [len(names) for line in by_row["one"] for names in classes_in(line)]
    outside = [line for line in by_row["outside"] if line["visible"] >= VISIBLE]
    controls = [line for row in CONTROLS for line in by_row[row]]
    steady = [line for line in lines if line["row"] != "onset"]
    cpu_s = [line["cpu_s"] for line in lines]

    def is_any_named(lines: list[Line]) -> list[bool]:
        return [bool(line["causes"] or line.get("beyond_the_list")) for line in lines]

    shares = [
        ("any name on plants without an effect", "at most 1 %", is_any_named(controls)),
        *((f"the same, {row}", "", is_any_named(by_row[row])) for row in CONTROLS),
        ("something negligible on them", "", [bool(line["negligible"]) for line in controls]),
        ("detected: any name, lambda > 30", "99 %", [bool(causes_in(line)) for line, _ in shown]),
        ("exact name, lambda > 30 and lambda_sep > 20", "98 %", exact_sets(by_row["one"])),
        (
            "truth in the reported class, lambda > 30",
            "98 %",
            [any(effect in names for names in classes_in(line)) for line, effect in shown],
        ),
        ("silent, lambda < 8", "", [not causes_in(line) for line in invisible]),
        ("exact set of 2, each separable", "95 %", exact_sets(by_row["two"])),
        ("exact set of 3, each separable", "90 %", exact_sets(by_row["three"])),
        ("exact set of 1 to 3, each separable", "", exact_sets(hiding)),
        ("95 % intervals cover the truth", "92 to 98 %", covered(same_law)),
        ("the same, beside an effect of another law", "", covered(other_law)),
        ("outside the list: flagged", "95 %", [bool(line["unexplained"]) for line in outside]),
        (
            "outside the list: dependence named",
            "80 %",
            [any(line["depends_on"] in name for name in line["unexplained"]) for line in outside],
        ),
        ("outside the list: false name", "at most 5 %", [bool(line["causes"]) for line in outside]),
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
        ("others: an onset or end told", "", [is_time_told(line) for line in steady]),
        ("motion recognised", "", [line["is_motion_right"] for line in lines]),
    ]
    mean_size = f"{np.mean(sizes):.2f}" if sizes else "none"
    medians = [
        ("mean size of a class", "at most 1.5", mean_size, len(sizes)),
        (
            "explainable error removed on a new flight: median, tenth percentile",
            "99 %, 95 %",
            percentiles(removed, 50, 10, unit=" %"),
            len(removed),
        ),
        (
            "CPU seconds a log: median, 95th percentile",
            "8, 15",
            percentiles(cpu_s, 50, 95),
            len(cpu_s),
        ),
    ]
    return [*(share_figure(*share) for share in shares), *(Figure(*median) for median in medians)]


def figures_by(name: str, values: Sequence[Any], lines: list[Line]) -> str:
    """Return the figures of the usual rate: of all lines, and of those with each value."""
    usual = select(lines, rate=USUAL_RATE)
    by_value = [figures(select(usual, **{name: value})) for value in values]
    rows = [
        [*figure, *(of_value.measured.split(" (")[0] for of_value in of_values)]
        for figure, *of_values in zip(figures(usual), *by_value, strict=True)
        if figure.n  # the page counts plants
    ]
    header = ["figure", "target", "all (95 % interval)", "n", *map(str, values)]
    return table(header, rows)


def figures_of_rates(lines: list[Line]) -> str:
    """Return names on clean plants and exact ones of other rates."""
    rows = []
    for rate, motion in sorted({(line["rate"], line["motion"]) for line in lines}):
        if rate == USUAL_RATE:
            continue
        clean, singles = (
            select(lines, motion=motion, rate=rate, row=row) for row in ("clean", "one")
        )
        is_named = [bool(line["causes"]) for line in clean]
        name = f"{rate} Hz, {motion}"
        rows.append(share_figure(f"{name}: any name on clean plants", "at most 2 %", is_named))
        rows.append(share_figure(f"{name}: exact single", "95 %", exact_sets(singles)))
    return figures_table(rows)


def count_names(pairs: Iterable[tuple[str, str]]) -> str:
    """Return a table of truths and how often each was given which name."""
    counts: dict[str, Counter[str]] = {}
    for truth, name in pairs:
        counts.setdefault(truth, Counter()).update([name])
    rows = [
        (truth, names.total(), ", ".join(f"{name} {n}" for name, n in names.most_common()))
        for truth, names in sorted(counts.items())
    ]
    return table("truth | plants | named", rows)


def misses(lines: list[Line]) -> str:
    """Return every plant on which a name was missing or false, with what could be known."""
    motions: dict[tuple[str, ...], list[str]] = {}
    for line in sorted(lines, key=lambda line: [line[name] for name in Trial._fields]):
        names = names_in(line)
        if not is_exact(line) and names != [CLOCK]:
            known = ", ".join(
                f"{name} {size:.2g}, {beside:.2g}"
                for name, (size, beside, _) in line.get("known", {}).items()
            )
            plant = (f"{line['rate']} Hz", line["truth"], ", ".join(names) or "none")
            motions.setdefault(plant, []).append(f"{line['motion']}: {known}")
    rows = [(*plant, "<br>".join(known)) for plant, known in motions.items()]
    return table("rate | truth | named | motion: lambda, lambda_sep", rows)


def main() -> None:
    """Write the page."""
    every_line = lines_of_commit(LINES, code=CODE)
    lines = good_lines(every_line)
    apart = [line for line in good_lines(lines_in(LINES)) if line["seed"] in KEPT_APART]
    rows = Counter(line["row"] for line in lines)
    singles = [
        (line["effects"][0], " + ".join(sorted(names_in(line))) or "none")
        for line in select(apart, row="one")
    ]
    outside = []
    for line in apart:
        if line.get("visible", 0.0) >= VISIBLE:
            names = {name.split(": ")[1].split(" at ")[0] for name in line["unexplained"]}
            outside.append((f"outside: {line['depends_on']}", " + ".join(sorted(names)) or "none"))
    fill_page(
        LINES.with_suffix(".md"),
        "diagnosis",
        plants=", ".join(f"{row} {rows[row]}" for row in ROWS),
        num_plants=len({(line["row"], line["number"], line["seed"]) for line in lines}),
        crashed=len(every_line) - len(lines),
        seeds=sorted({line["seed"] for line in every_line}),
        commit=", ".join(list_commits(every_line)),
        date=every_line[-1]["date"],
        machines="; ".join(sorted({line["machine"] for line in every_line})),
        visible=VISIBLE,
        figures=figures_by("motion", MOTIONS, lines),
        kept_apart=", ".join(map(str, KEPT_APART)),
        seeds_apart=figures_by("seed", KEPT_APART, apart),
        rates=figures_of_rates(apart),
        names=count_names([*singles, *outside]),
        misses=misses(apart),
    )


if __name__ == "__main__":
    main()
