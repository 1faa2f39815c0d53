"""Laws outside the package's list: what the diagnosis learns of them.

Usage: ``python -m benchmarks.beyond [--laws 4] [--clean 20] [--listed 10] [--page]``.

Flies plants with laws outside the package's list (equations of their own), clean ones, and ones
with listed effects only, a minute each, and grades what the diagnosis learns of each: is the
variable right, and the form; how much of the explainable error goes on a new flight. It appends a
line a plant to docs/results/beyond.jsonl and skips plants that have a line of the same commit;
--page writes docs/results/beyond.md, of the last line of each plant.
"""

import json
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from benchmarks import hidden, report
from benchmarks.diagnosis import model_of, round_values
from benchmarks.hidden.oracle import removed
from benchmarks.real.crafts import CRAFTS
from benchmarks.real.section import formulas_of
from benchmarks.real_logs import record_path
from benchmarks.report import Line
from flytrack_sysid.diagnosis import diagnose
from flytrack_sysid.log import FlightLog

LINES = report.RESULTS / "beyond.jsonl"
# Rules were looked at on seeds 7, 41, 43, 47, 53, 59 and 61; none was made on what the page shows.
SEED, SECONDS = 67, 60.0
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


class Trial(NamedTuple):
    """One plant: a kind of law, clean or listed; its number and the seed."""

    row: str
    number: int
    seed: int = SEED


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


def flown_plant(trial: Trial) -> tuple[hidden.Truth, FlightLog, np.random.Generator]:
    """Return one plant, a measured flight of it, and what draws more of them."""
    row, number, seed = trial
    rng = np.random.default_rng([seed, number, sorted([*KINDS, "clean", "listed"]).index(row)])
    truth = replace(truth_of(row, rng), motion=hidden.MOTIONS[number % len(hidden.MOTIONS)])
    return truth, hidden.measure(hidden.fly(truth, SECONDS, rng), "sensors", rng), rng


def plant(trial: Trial) -> Line:
    """Return what was learnt of one plant, graded."""
    truth, log, rng = flown_plant(trial)
    started_s = time.process_time()
    diagnosis = diagnose(log, model_of(truth))
    line: Line = {
        "truth": truth.text(),
        "motion": truth.motion,
        "found_motion": diagnosis.extended.motion.value,
        "verdict": diagnosis.verdict,
        "causes": [cause.effect for cause in diagnosis.causes],
        "unexplained": round_values(diagnosis.unexplained.shares),
        "law": [],
        "cpu_s": round(time.process_time() - started_s, 1),
    }
    learned = diagnosis.learned
    if learned is not None:
        terms = learned.law.terms
        line["law"] = [term.text() for term in terms]
        if trial.row in RIGHT:
            quantities, shapes = RIGHT[trial.row]
            factors = terms[0].factors
            line["is_variable"] = any(factor.quantity in quantities for factor in factors)
            is_shape = any(factor.shape in shapes for factor in factors)
            line["is_form"] = line["is_variable"] and is_shape
        clean = hidden.fly(truth, SECONDS, rng)
        neutral = learned.effect._replace(scale=0.0)
        share, size = removed(clean, diagnosis.base.with_effects(neutral), diagnosis.extended)
        line["removed"] = [round(share, 4), round(size, 4)]
    return line


def figures(lines: Sequence[Line]) -> list[report.Figure]:
    """Return the figures of graded plants."""
    laws = [line for line in lines if line["row"] in RIGHT]
    unexplained = [line for line in laws if line["unexplained"]]
    learned = [line for line in laws if line["law"]]
    loads = report.select(lines, row=LOAD)
    # A thermal is elsewhere on every flight, so that a new one says nothing of it.
    on_new_flights = [line for line in laws if "removed" in line and line["row"] != "position"]
    removed_percent = [100.0 * line["removed"][0] for line in on_new_flights]
    cpu_s = [line["cpu_s"] for line in lines]

    def flags(lines: Iterable[Line], name: str) -> list[bool]:
        return [bool(line.get(name)) for line in lines]

    shares = [
        ("variable right", "70 %", flags(laws, "is_variable")),
        ("variable and form right", "70 %", flags(laws, "is_form")),
        ("the same, of those left unexplained", "", flags(unexplained, "is_form")),
        ("law of another variable", "at most 2 %", [not line["is_variable"] for line in learned]),
    ]
    for row in ("clean", "listed"):
        controls = report.select(lines, row=row)
        shares.append((f"law, {row}", "at most 1 %", flags(controls, "law")))
    if loads:
        is_unexplained = ["unexplained" in line["verdict"] for line in loads]
        shares.append(("swinging load left unexplained", "100 %", is_unexplained))
    return [
        *(report.share_figure(*share) for share in shares),
        report.Figure(
            "explainable error removed on a new flight, median of those learnt",
            "90 %",
            f"{np.median(removed_percent):.0f} %" if removed_percent else "none",
            len(removed_percent),
        ),
        report.Figure("CPU seconds a log, median", "", f"{np.median(cpu_s):.0f}", len(cpu_s)),
    ]


def kinds_table(lines: Sequence[Line]) -> str:
    """Return, by kind of law, the numbers of plants, of right forms and of laws learnt."""
    rows = []
    for kind in RIGHT:
        plants = report.select(lines, row=kind)
        num_right = sum(line.get("is_form", False) for line in plants)
        rows.append((kind, len(plants), num_right, sum(bool(line["law"]) for line in plants)))
    return report.table("kind | plants | form right | any law learnt", rows)


def _learned_cells(diagnosis: Any) -> tuple[str, str, str]:
    """Return what a diagnosis learnt, and the median and largest ratio of errors.

    Errors are of free flight on held-out rows, over those of the extended model without it.
    """
    if diagnosis["learned"] is None:
        has_law = any("from another log" in warning for warning in diagnosis["warnings"])
        return "not looked for: the model has a law" if has_law else "nothing", "-", "-"
    errors = diagnosis["prediction"]["errors"]
    ratios = [
        errors["extended"][quantity][horizon] / without
        for quantity, by_horizon in errors["without_learned"].items()
        for horizon, without in by_horizon.items()
    ]
    formulas = "; ".join(formulas_of(diagnosis["learned"]))
    return formulas, f"{np.median(ratios):.2f}", f"{max(ratios):.2f}"


def real_table() -> str:
    """Return a table of what each diagnosis of measured flights learnt."""
    rows = []
    for name in sorted(CRAFTS):
        record = json.loads(record_path(name).read_text(encoding="utf-8"))
        for number, part in enumerate(CRAFTS[name].diagnoses(record).values()):
            rows.append((f"{name} {number + 1}", *_learned_cells(part["diagnosis"])))
    return report.table("flights | learnt | error over the one without, median | largest", rows)


def write_page() -> None:
    """Write the page of the last line of each plant, and of measured flights."""
    last = {tuple(line[name] for name in Trial._fields): line for line in report.lines_in(LINES)}
    lines = [*last.values()]
    sources = sorted({f"seed {line['seed']} at commit {line['commit']}" for line in lines})
    good = report.good_lines(lines)
    report.fill_page(
        LINES.with_suffix(".md"),
        "beyond",
        sources=", ".join(sources),
        crashed=len(lines) - len(good),
        figures=report.figures_table(figures(good)),
        kinds=kinds_table(good),
        real=real_table(),
    )


def main(
    laws: int = 4,
    clean: int = 20,
    listed: int = 10,
    kinds: tuple[str, ...] = KINDS,
    page: bool = False,
    jobs: report.JobFlags = report.IN_THIS_PROCESS,
) -> None:
    """Diagnose the plants, or write the page.

    Args:
        laws: plants of each kind of law.
        clean: without anything.
        listed: with listed effects only.
        kinds: of laws, so that two processes can share them.
        page: write the page of what was measured.
    """
    if page:
        write_page()
        return
    counts = dict.fromkeys(kinds, laws) | {"clean": clean, "listed": listed}
    most = max(counts.values())
    trials = [
        Trial(row, number)
        for number in range(most)
        for row, count in counts.items()
        if number < count
    ]
    report.record_trials(LINES, trials, plant, PLANTS_A_CACHE, jobs)


if __name__ == "__main__":
    report.command(main)
