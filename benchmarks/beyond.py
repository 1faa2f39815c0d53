"""Laws outside the package's list: what the diagnosis learns of them.

Usage: ``python -m benchmarks.beyond [--laws 4] [--clean 20] [--listed 10] [--page]``.

Flies plants with laws outside the package's list (benchmarks.hidden.outside, equations of their
own), clean ones, and ones with listed effects only, a minute each, and grades what the diagnosis
learns of each: is the variable right, and the form; how much of the explainable error goes on a new
flight. It appends a line a plant to docs/results/beyond.jsonl and skips plants that have a line of
the same commit; --page writes docs/results/beyond.md, of the last lines of each sort.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from benchmarks import hidden, report
from benchmarks.diagnosis import model_of
from benchmarks.hidden.oracle import removed
from benchmarks.real.section import formulas_of
from flytrack_sysid.diagnosis import diagnose
from flytrack_sysid.log import FlightLog

LINES = report.RESULTS / "beyond.jsonl"
REAL = report.ROOT / "benchmarks" / "data" / "real"  # `python -m benchmarks.real_logs --diagnose`
SEED, SECONDS = 67, 60.0  # rules were looked at on seeds 7, 41, 43, 47, 53, 59 and 61
# On the page: no rule was made on these laws, and none on plants without a law of two seeds more.
SEEDS_OF_LAWS = (61, SEED)
SEEDS_OF_CONTROLS = (53, 59, *SEEDS_OF_LAWS)
PLANTS_A_CACHE = 15  # a process may map only so many compiled programs into its memory
AMPLITUDES = (1.0, 3.0)  # times the noise of the sensor in the law's channel
# Kind of law -> quantities, and shapes, that are right.
RIGHT: dict[str, tuple[set[str], set[str]]] = {
    "position": ({"position"}, {"place"}),
    "time": ({"time"}, {"step", "bump"}),
    "heading": ({"heading"}, {"wave"}),
    "airspeed": ({"airspeed"}, {"bump"}),
    "attitude": ({"tilt"}, {"bump"}),
    "command": ({"roll", "pitch", "yaw", "throttle"}, {"bump", "step"}),
    "flapping": ({"airspeed_x"}, {"power"}),
    "cable": ({"heading"}, {"wave"}),
    "heating": ({"time"}, {"saturation", "power", "step"}),
}
LOAD = "payload"  # swings on a string, for which the grammar has no term
KINDS = (*RIGHT, LOAD)
Trial = tuple[str, int]


def truth_of(row: str, rng: np.random.Generator) -> hidden.Truth:
    """Return a plant: clean, with listed effects, or with a law."""
    if row == "listed":
        return hidden.draw_truth(rng, int(rng.integers(1, 3)))
    truth = hidden.draw_base(rng)
    if row == "clean":
        return truth
    return replace(
        truth, outside=hidden.draw_outside(rng, row, hidden.log_uniform(*AMPLITUDES, rng))
    )


def flown_plant(row: str, number: int) -> tuple[hidden.Truth, FlightLog, np.random.Generator]:
    """Return one plant, a measured flight of it, and what draws more of them."""
    rng = np.random.default_rng([SEED, number, sorted([*KINDS, "clean", "listed"]).index(row)])
    truth = replace(truth_of(row, rng), motion=hidden.MOTIONS[number % len(hidden.MOTIONS)])
    return truth, hidden.measure(hidden.fly(truth, SECONDS, rng), "sensors", rng), rng


def plant(row: str, number: int) -> dict[str, Any]:
    """Return what was learnt of one plant, graded."""
    truth, log, rng = flown_plant(row, number)
    started_s = time.process_time()
    found = diagnose(log, model_of(truth))
    line: dict[str, Any] = {
        "truth": truth.text(),
        "motion": truth.motion,
        "found_motion": found.extended.motion.value,
        "verdict": found.verdict,
        "causes": [one.effect for one in found.causes],
        "unexplained": {name: round(size, 3) for name, size in found.unexplained.shares.items()},
        "law": [],
        "cpu_s": round(time.process_time() - started_s, 1),
    }
    learned = found.learned
    if learned is not None:
        line["law"] = [one.text() for one in learned.law.terms]
        if row in RIGHT:
            quantities = {one.quantity for one in learned.law.terms[0].factors}
            shapes = {one.shape for one in learned.law.terms[0].factors}
            line["is_variable"] = bool(quantities & RIGHT[row][0])
            line["is_form"] = line["is_variable"] and bool(shapes & RIGHT[row][1])
        clean = hidden.fly(truth, SECONDS, rng)
        neutral = learned.effect._replace(scale=0.0)
        share, size = removed(clean, found.base.with_effects(neutral), found.extended)
        line["removed"] = [round(share, 4), round(size, 4)]
    return line


def run(trials: Sequence[Trial]) -> None:
    """Diagnose what has no line of this commit yet, and append the lines."""
    commit = report.commit_of_checkout()
    done = {(line["row"], line["number"]) for line in report.lines_of_commit(LINES, commit)}
    left = [one for one in trials if one not in done]
    for place, (row, number) in enumerate(report.progress(left, "plants")):
        if place % PLANTS_A_CACHE == 0:
            jax.clear_caches()
        line = {"row": row, "number": number, "seed": SEED, "commit": commit}
        try:
            line |= plant(row, number)
        except Exception as error:  # a crash is a result too, and the others go on
            line["error"] = f"{type(error).__name__}: {error}"
        report.append_line(LINES, line)


def figures(lines: Sequence[dict[str, Any]]) -> list[report.Figure]:
    """Return the figures of graded plants."""
    laws = [line for line in lines if line["row"] in RIGHT]
    unexplained = [line for line in laws if line["unexplained"]]
    learned = [line for line in laws if line["law"]]
    controls = {
        row: [bool(line["law"]) for line in lines if line["row"] == row]
        for row in ("clean", "listed")
    }
    loads = ["unexplained" in line["verdict"] for line in lines if line["row"] == LOAD]
    shares = [
        ("variable right", "70 %", [line.get("is_variable", False) for line in laws]),
        ("variable and form right", "70 %", [line.get("is_form", False) for line in laws]),
        (
            "the same, of those left unexplained",
            "",
            [line.get("is_form", False) for line in unexplained],
        ),
        ("law of another variable", "at most 2 %", [not line["is_variable"] for line in learned]),
        *((f"law, {row}", "at most 1 %", flags) for row, flags in controls.items()),
        *([("swinging load left unexplained", "100 %", loads)] if loads else []),
    ]
    # A thermal is elsewhere on every flight, so that a new one says nothing of it.
    on_new_flights = [line for line in laws if "removed" in line and line["row"] != "position"]
    removed_percent = [100.0 * line["removed"][0] for line in on_new_flights]
    cpu_s = [line["cpu_s"] for line in lines]
    return [
        *(report.Figure(name, target, *report.share(flags)) for name, target, flags in shares),
        report.Figure(
            "explainable error removed on a new flight, median of those learnt",
            "90 %",
            f"{np.median(removed_percent):.0f} %" if removed_percent else "none",
            len(removed_percent),
        ),
        report.Figure("CPU seconds a log, median", "", f"{np.median(cpu_s):.0f}", len(cpu_s)),
    ]


def kind_rows(lines: Sequence[dict[str, Any]]) -> list[tuple[str, int, int, int]]:
    """Return, by kind of law, the numbers of plants, of right forms and of laws learnt."""
    rows = []
    for kind in RIGHT:
        own = [line for line in lines if line["row"] == kind]
        right = sum(one.get("is_form", False) for one in own)
        rows.append((kind, len(own), right, sum(bool(one["law"]) for one in own)))
    return rows


def diagnoses_of(record: Any) -> list[dict[str, Any]]:
    """Return the diagnoses anywhere in a record of measured flights."""
    if isinstance(record, list):
        return [found for one in record for found in diagnoses_of(one)]
    if not isinstance(record, dict):
        return []
    if "diagnosis" in record:
        return [record["diagnosis"]]
    return [found for one in record.values() for found in diagnoses_of(one)]


def real_rows() -> list[tuple[str, str, str, str]]:
    """Return what each diagnosis of measured flights learnt, and its ratios of errors.

    Errors are of velocity and position on held-out rows, over those of the extended model without
    it.
    """
    rows = []
    for path in sorted(REAL.glob("*_diagnosis.json")):
        for number, found in enumerate(diagnoses_of(json.loads(path.read_text()))):
            name = f"{path.stem.removesuffix('_diagnosis')} {number + 1}"
            learned, errors = found["learned"], found["prediction"]["errors"]
            if learned is None:
                has_law = any("from another log" in warning for warning in found["warnings"])
                rows.append(
                    (
                        name,
                        "not looked for: the model has a law" if has_law else "nothing",
                        "-",
                        "-",
                    )
                )
                continue
            ratios = [
                errors["extended"][quantity][horizon] / before
                for quantity, by_horizon in errors["without_learned"].items()
                if quantity.split("_")[0] in ("velocity", "position")
                for horizon, before in by_horizon.items()
            ]
            rows.append(
                (
                    name,
                    "; ".join(formulas_of(learned)),
                    f"{np.median(ratios):.2f}",
                    f"{max(ratios):.2f}",
                )
            )
    return rows


def write_page() -> None:
    """Write the page of each seed's last plants with and without a law, and of measured flights."""
    every = report.lines_in(LINES)
    last = {(line["row"] in KINDS, line["seed"]): line["commit"] for line in every}
    laws = [(True, seed) for seed in SEEDS_OF_LAWS]
    controls = [(False, seed) for seed in SEEDS_OF_CONTROLS]
    used = {*laws, *controls} & set(last)
    lines = [
        line
        for line in every
        if (key := (line["row"] in KINDS, line["seed"])) in used and line["commit"] == last[key]
    ]
    good = [line for line in lines if "error" not in line]
    rows = [
        (
            line["row"],
            line["truth"],
            "; ".join(line["law"]) or "none",
            ", ".join(line["unexplained"]) or "nothing unexplained",
        )
        for line in sorted(good, key=lambda line: (line["row"], line["seed"], line["number"]))
        if line["row"] in KINDS or line["law"]
    ]
    report.fill_page(
        LINES.with_suffix(".md"),
        "beyond",
        **{
            name: ", ".join(f"seed {one[1]} at commit {last[one]}" for one in keys if one in used)
            for name, keys in (("laws", laws), ("controls", controls))
        },
        crashed=len(lines) - len(good),
        figures=report.figures_table(figures(good)),
        kinds=report.table("kind | plants | form right | any law learnt", kind_rows(good)),
        real=report.table(
            "flights | learnt | error over the one without, median | largest", real_rows()
        ),
        plants=report.table("kind | truth | learnt | left unexplained by the list", rows),
    )


def main(
    laws: int = 4,
    clean: int = 20,
    listed: int = 10,
    kinds: tuple[str, ...] = KINDS,
    page: bool = False,
) -> None:
    """Diagnose the plants, or write the page.

    laws: plants of each kind of law. clean: without anything. listed: with listed effects only.
    kinds: of laws, so that two processes can share them. page: write the page of what was measured.
    """
    if page:
        write_page()
        return
    counts = dict.fromkeys(kinds, laws) | {"clean": clean, "listed": listed}
    most = max(counts.values())
    run(
        [(row, number) for number in range(most) for row, count in counts.items() if number < count]
    )


if __name__ == "__main__":
    report.command(main)
