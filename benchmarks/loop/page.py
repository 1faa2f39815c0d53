"""The page of the loop's benchmark: each policy on each plant, and what the extension changed.

Beside the page are a chart and a .jsonl: what was run in its first line, a plant in each other.
"""

import json
import math
import re
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from benchmarks import report
from flytrack_env.effects import BY_NAME
from flytrack_env.files import write_atomically
from flytrack_env.pictures.drawing import new_figure, plain, png_of
from flytrack_env.scene import BLUE, GREEN, GREY, ORANGE

POLICIES = {  # stage -> its policy's name
    "before": "minimal model",
    "after": "extended model",
    "refitted_base": "refitted base",
    "nominal": "nominal model",
    "randomised": "randomised, no identification",
}
RACE = ("finish", "lap (s)", "gap (%)")
# The hidden effects matter where the minimal model's policy is worse than this.
MATTERS_BELOW, MATTERS_ABOVE_PERCENT = 0.80, 3.0
TARGET_SUCCESS, TARGET_GAP_PERCENT, TARGET_SHARE = 0.95, 1.0, 0.9
MAX_GAP_PERCENT = 10.0  # larger gaps are drawn here
DPI = 150
HEIGHT_IN, ROW_IN, PANEL_IN = 1.5, 0.2, 2.0  # of the chart: beside the rows, a row, a panel
Stage = dict[str, Any]
Stages = dict[str, Stage]  # of a plant, by name


def gap_percent(stage: Stage) -> float:
    """Return the size of a stage's lap gap, %; infinite where no lap was completed."""
    gap = stage["lap_gap_percent"]
    return math.inf if gap is None else abs(gap)


def does_matter(stages: Stages) -> bool:
    """Return whether the hidden effects spoil the race of the minimal model's policy."""
    before = stages["before"]
    return before["plant"]["success"] < MATTERS_BELOW or gap_percent(before) > MATTERS_ABOVE_PERCENT


def is_reached(stages: Stages) -> bool:
    """Return whether the extended model's policy races as it should."""
    after = stages["after"]
    return after["plant"]["success"] >= TARGET_SUCCESS and gap_percent(after) <= TARGET_GAP_PERCENT


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _race_cells(stage: Stage) -> list[str]:
    plant = stage["plant"]
    return [
        f"{plant['success']:.1%}",
        _number(plant["flying_lap_s"], ".3f"),
        _number(stage["lap_gap_percent"], "+.2f"),
    ]


def _names(text: str) -> str:
    """Return what is hidden without its numbers."""
    return re.sub(r"\(.*?\)", "", text).replace(" + ", ", ")


def race_table(results: list[dict[str, Any]], by_job: dict[str, Stages]) -> str:
    """Return how the policies of minimal and extended model race, and their models' errors."""
    rows = []
    for result in results:
        stages = by_job[result["job"]]
        errors = [stages[name]["errors"]["position_m"].get("1") for name in ("before", "after")]
        rows.append(
            [
                result["job"] + (", matters" if does_matter(stages) else ""),
                _names(result["hidden"]),
                *_race_cells(stages["before"]),
                *_race_cells(stages["after"]),
                " to ".join(_number(error, ".2f") for error in errors),
            ]
        )
    heads = [f"{model}: {head}" for model in ("minimal", "extended") for head in RACE]
    return report.table(["plant", "hidden", *heads, "free flight of 1 s (m)"], rows)


def false_names(results: list[dict[str, Any]]) -> str:
    """Return the effects that were named and are not in the plant, by plant."""
    by_plant = []
    for result in results:
        true_names = re.findall(r"\w+", _names(result["hidden"]))
        names = [name for name in result["causes"] if name in BY_NAME and name not in true_names]
        if names and result["job"] != "shipped":  # of which no truth is published
            by_plant.append(f"{result['job']}: {', '.join(names)}")
    return "; ".join(by_plant) or "none"


def figures(plants: list[Stages]) -> tuple[list[report.Figure], bool]:
    """Return the figures of the extended model's policy, and whether the target is met.

    Without a plant that matters it is.
    """
    is_met = [is_reached(stages) for stages in plants if does_matter(stages)]
    races = [(stages["before"]["plant"], stages["after"]["plant"]) for stages in plants]
    laps_s = [(before["flying_lap_s"], after["flying_lap_s"]) for before, after in races]
    shorter = [100.0 * (1.0 - after / before) for before, after in laps_s if before and after]
    lowest = min((after["success"] for _, after in races), default=math.nan)
    widest = max((gap_percent(stages["after"]) for stages in plants), default=math.nan)
    middle = f"{median(shorter):.1f} % ({report.spread(shorter, '+.1f')} %)" if shorter else "none"
    goal = f"at least {TARGET_SUCCESS:.0%} finish, lap gap at most {TARGET_GAP_PERCENT:g} %"
    lap = "flying lap, shorter than the minimal model's policy's"
    return [
        report.share_figure(f"plants that matter: {goal}", f"{TARGET_SHARE:.0%}", is_met),
        report.Figure("all plants: fewest that finish", "", f"{lowest:.1%}", len(plants)),
        report.Figure("all plants: largest lap gap", "", f"{widest:.2f} %", len(plants)),
        report.Figure(lap, "", middle, len(shorter)),
    ], sum(is_met) >= TARGET_SHARE * len(is_met)


def draw_policy(axes: Axes, stages: list[Stage]) -> int:
    """Draw a policy's lap gaps, a row a plant; return on how many it reaches the target."""
    plain(axes).axvspan(-TARGET_GAP_PERCENT, TARGET_GAP_PERCENT, color=GREEN, alpha=0.15)
    num_good = 0
    for row, stage in enumerate(stages):
        success, gap = stage["plant"]["success"], stage["lap_gap_percent"]
        if gap is None:
            axes.text(0.0, row, "no lap", fontsize=6, color=GREY, va="center", ha="center")
            continue
        does_finish = success >= TARGET_SUCCESS
        is_good = does_finish and abs(gap) <= TARGET_GAP_PERCENT
        num_good += is_good
        shown = float(np.clip(gap, -MAX_GAP_PERCENT, MAX_GAP_PERCENT))
        mark = "o" if shown == gap else ">" if gap > 0.0 else "<"
        colour = BLUE if is_good else ORANGE if does_finish else GREY
        axes.plot(shown, row, mark, color=colour, markersize=5, clip_on=False, zorder=3)
        if not does_finish:
            axes.annotate(
                f"{success:.0%} finish",
                (shown, row),
                (-6 if gap > 0.0 else 6, 0),
                textcoords="offset points",
                fontsize=6,
                color=GREY,
                va="center",
                ha="right" if gap > 0.0 else "left",
            )
    return num_good


def draw_chart(by_job: dict[str, Stages]) -> bytes:
    """Return the chart as PNG: a panel a policy, a row a plant, its lap gap and who finishes.

    Plants that matter are on top.
    """
    jobs = sorted(reversed(by_job), key=lambda job: does_matter(by_job[job]))
    figure = new_figure(PANEL_IN * len(POLICIES) + 0.6, HEIGHT_IN + ROW_IN * len(jobs))
    panels = figure.subplots(1, len(POLICIES), sharex=True, sharey=True)
    num_quiet = sum(not does_matter(stages) for stages in by_job.values())
    for axes, (name, label) in zip(panels, POLICIES.items(), strict=True):
        num_good = draw_policy(axes, [by_job[job][name] for job in jobs])
        title = f"{label.split(',')[0]}\n{num_good} of {len(jobs)} reach the target"
        axes.set_title(title, fontsize=8, loc="left")
        axes.axhline(num_quiet - 0.5, color="0.4", linewidth=0.8)
        axes.tick_params(labelsize=7)
    panels[0].set_yticks(range(len(jobs)), jobs)
    panels[0].set_ylim(-0.7, len(jobs) - 0.3)
    panels[0].set_xlim(-1.05 * MAX_GAP_PERCENT, 1.05 * MAX_GAP_PERCENT)
    figure.supylabel("plant (above the line: effects matter)", fontsize=8)
    caption = (
        "how much longer the lap is on the plant than in the policy's simulator (%)\n"
        f"triangle: beyond {MAX_GAP_PERCENT:g} %. grey: fewer than {TARGET_SUCCESS:.0%} finish. "
        "shaded: the target"
    )
    figure.supxlabel(caption, fontsize=8)
    return png_of(figure, DPI)


def write_records(path: Path, results: list[dict[str, Any]], about: dict[str, Any]) -> None:
    """Write what the page and the chart are made of, a plant a line, below what was run."""
    kept = ("job", "hidden", "causes", "race_log_s", "stages")
    lines = [about, *({name: result[name] for name in kept} for result in results)]
    write_atomically(path, "".join(f"{json.dumps(line)}\n" for line in lines).encode())


def read_records(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return what was run, and the plants, of a .jsonl beside a page."""
    about, *results = map(json.loads, path.read_text(encoding="utf-8").splitlines())
    return about, results


def write_page(path: Path, results: list[dict[str, Any]], about: dict[str, Any]) -> bool:
    """Write the page and its chart; return whether the target is met.

    Args:
        path: of the page; the chart is beside it.
        results: of the plants.
        about: ``command``, ``steps`` of a training, ``cpu_min``, ``provenance``, and ``notes`` on
            these results, if any.
    """
    by_job = {
        result["job"]: {stage["name"]: stage for stage in result["stages"]} for result in results
    }
    rows, is_met = figures([*by_job.values()])
    chart = path.with_suffix(".png")
    write_atomically(chart, draw_chart(by_job))
    text = report.filled(
        "loop",
        command=about["command"],
        millions=about["steps"] / 1e6,
        figures=report.figures_table(rows),
        below=MATTERS_BELOW,
        above_percent=MATTERS_ABOVE_PERCENT,
        chart=chart.name,
        race=race_table(results, by_job),
        false_names=false_names(results),
        notes=f"{about['notes']}\n\n" if about.get("notes") else "",
        records=path.with_suffix(".jsonl").name,
        cpu_min=about["cpu_min"],
        provenance=about["provenance"],
    )
    report.write_page(path, text)
    return is_met
