"""The page of the loop's benchmark: each policy on each plant, and what the extension changed."""

import math
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks import report
from flytrack_env.files import write_atomically
from flytrack_env.pictures.drawing import png_of

# Stage -> its policy's name, and its mark and colour in the chart.
POLICIES = {
    "before": ("minimal model", "o", "C3"),
    "after": ("extended model", "o", "C2"),
    "refitted_base": ("refitted base", "s", "C0"),
    "nominal": ("nominal model", "v", "0.5"),
    "randomised": ("randomised, no identification", "^", "C1"),
}
# The hidden effects matter where the minimal model's policy is worse than this.
MATTERS_BELOW, MATTERS_ABOVE_PERCENT = 0.80, 3.0
TARGET_SUCCESS, TARGET_GAP_PERCENT, TARGET_SHARE = 0.95, 1.0, 0.9
MAX_GAP_PERCENT = 10.0  # larger gaps, and policies without a lap, are drawn here
SPREAD = 0.12  # between the marks of a column
DPI = 130
# Kind, key and format of the errors of a model.
ERRORS = (
    ("one_step_nrmse", "v", ".4f"),
    ("one_step_nrmse", "q", ".4f"),
    ("position_m", "1", ".3f"),
)
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


def _race_cell(stage: Stage) -> str:
    plant, gap = stage["plant"], stage["lap_gap_percent"]
    success = f"{plant['success']:.1%} ({stage['simulator']['success']:.1%})"
    return f"{success}, {_number(plant['flying_lap_s'], '.3f')} s, {_number(gap, '+.2f')} %"


def race_table(by_job: dict[str, Stages]) -> str:
    """Return success and flying lap on the plant, and the gap to the simulator, by policy."""
    rows = []
    for job, stages in by_job.items():
        cells = [_race_cell(stages[name]) for name in POLICIES]
        rows.append([job, "yes" if does_matter(stages) else "no", *cells])
    return report.table(["plant", "matters", *(name for name, _, _ in POLICIES.values())], rows)


def model_table(results: list[dict[str, Any]], by_job: dict[str, Stages]) -> str:
    """Return hidden and named effects, and the models' errors on held-out flights."""
    rows = []
    for result in results:
        stages = by_job[result["job"]]
        errors = [stages[name]["errors"] for name in ("before", "refitted_base", "after")]
        cells = [
            " / ".join(_number(error[kind].get(key), digits) for error in errors)
            for kind, key, digits in ERRORS
        ]
        names = ", ".join(result["causes"]) or "nothing"
        log = f"{result['race_log_s']:g} s"
        rows.append([result["job"], result["hidden"], names, log, *cells])
    return report.table(
        "plant | hidden | named | log | velocity | attitude | free flight of 1 s (m)", rows
    )


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


def draw_chart(by_job: dict[str, Stages]) -> bytes:
    """Return the chart as PNG: success and lap gap, a column per plant, a mark per policy."""
    figure = Figure(figsize=(max(7.0, 0.75 * len(by_job) + 2.0), 6.0), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    for number, (name, (label, marker, colour)) in enumerate(POLICIES.items()):
        stages = [stages[name] for stages in by_job.values()]
        columns = np.arange(len(stages)) + SPREAD * (number - 2)
        success = [100.0 * stage["plant"]["success"] for stage in stages]
        gap = np.minimum([gap_percent(stage) for stage in stages], MAX_GAP_PERCENT)
        for axes, values in ((upper, success), (lower, gap)):
            axes.plot(columns, values, marker, color=colour, label=label, markersize=7)
    upper.set(ylabel="finish 3 laps on the plant (%)", ylim=(None, 101.0))
    lower.set(xlabel="plant", ylabel=f"|lap gap| (%), {MAX_GAP_PERCENT:g}: more, or no lap")
    lower.set_xticks(range(len(by_job)), [*by_job])
    for axes, target in ((upper, 95.0), (lower, 1.0)):
        axes.axhline(target, color="0.7", linewidth=1.0)
        axes.grid(axis="y", alpha=0.3)
    figure.legend(*upper.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return png_of(figure, DPI)


def write_page(path: Path, results: list[dict[str, Any]], steps: int) -> bool:
    """Write the page and its chart; return whether the target is met."""
    by_job = {
        result["job"]: {stage["name"]: stage for stage in result["stages"]} for result in results
    }
    rows, is_met = figures([*by_job.values()])
    chart = path.with_suffix(".png")
    write_atomically(chart, draw_chart(by_job))
    report.fill_page(
        path,
        "loop",
        millions=steps / 1e6,
        figures=report.figures_table(rows),
        below=MATTERS_BELOW,
        above_percent=MATTERS_ABOVE_PERCENT,
        chart=chart.name,
        race=race_table(by_job),
        models=model_table(results, by_job),
        cpu_min=sum(result["cpu_s"] for result in results) / 60.0,
    )
    return is_met
