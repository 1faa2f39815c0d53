"""The page of the loop's benchmark: each policy on each plant, and what the extension changed."""

import math
from pathlib import Path
from statistics import median
from typing import Any

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
LARGEST_GAP_PERCENT = 10.0  # larger gaps, and policies without a lap, are drawn here
SPREAD = 0.12  # between the marks of a column
DPI = 130


def stage(result: dict[str, Any], name: str) -> dict[str, Any]:
    """Return one stage of a plant's result."""
    return next(one for one in result["stages"] if one["name"] == name)


def gap_percent(one: dict[str, Any]) -> float:
    """Return the size of a stage's lap gap, %; infinite where no lap was completed."""
    gap = one["lap_gap_percent"]
    return math.inf if gap is None else abs(gap)


def does_matter(result: dict[str, Any]) -> bool:
    """Return whether the hidden effects spoil the race of the minimal model's policy."""
    before = stage(result, "before")
    return before["plant"]["success"] < MATTERS_BELOW or gap_percent(before) > MATTERS_ABOVE_PERCENT


def is_reached(result: dict[str, Any]) -> bool:
    """Return whether the extended model's policy races as it should."""
    after = stage(result, "after")
    return after["plant"]["success"] >= TARGET_SUCCESS and gap_percent(after) <= TARGET_GAP_PERCENT


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _race_cell(one: dict[str, Any]) -> str:
    plant, gap = one["plant"], one["lap_gap_percent"]
    success = f"{plant['success']:.1%} ({one['simulator']['success']:.1%})"
    return f"{success}, {_number(plant['flying_lap_s'], '.3f')} s, {_number(gap, '+.2f')} %"


def race_table(results: list[dict[str, Any]]) -> str:
    """Return success and flying lap on the plant, and the gap to the simulator, by policy."""
    rows = [
        [
            result["job"],
            "yes" if does_matter(result) else "no",
            *(_race_cell(stage(result, name)) for name in POLICIES),
        ]
        for result in results
    ]
    return report.table(["plant", "matters", *(name for name, _, _ in POLICIES.values())], rows)


def model_table(results: list[dict[str, Any]]) -> str:
    """Return hidden and named effects, and the models' errors on held-out flights."""
    rows = []
    for result in results:
        errors = [stage(result, name)["errors"] for name in ("before", "refitted_base", "after")]
        cells = [
            [_number(one["one_step_nrmse"].get(channel), ".4f") for one in errors]
            for channel in "vq"
        ]
        cells.append([_number(one["position_m"].get("1"), ".3f") for one in errors])
        names = ", ".join(result["causes"]) or "nothing"
        log = f"{result['race_log_s']:g} s"
        rows.append([result["job"], result["hidden"], names, log, *map(" / ".join, cells)])
    return report.table(
        "plant | hidden | named | log | velocity | attitude | free flight of 1 s (m)", rows
    )


def figures(results: list[dict[str, Any]]) -> tuple[list[report.Figure], bool]:
    """Return the figures of the extended model's policy, and whether the target is met.

    Without a plant that matters it is.
    """
    matter = [result for result in results if does_matter(result)]
    reached = [is_reached(result) for result in matter]
    pairs = [(stage(result, "before"), stage(result, "after")) for result in results]
    laps = [tuple(one["plant"]["flying_lap_s"] for one in pair) for pair in pairs]
    shorter = [100.0 * (1.0 - after / before) for before, after in laps if before and after]
    lowest = min((after["plant"]["success"] for _, after in pairs), default=math.nan)
    widest = max((gap_percent(after) for _, after in pairs), default=math.nan)
    middle = f"{median(shorter):.1f} % ({report.spread(shorter, '+.1f')} %)" if shorter else "none"
    goal = f"at least {TARGET_SUCCESS:.0%} finish, lap gap at most {TARGET_GAP_PERCENT:g} %"
    found = [
        report.Figure(f"plants that matter: {goal}", f"{TARGET_SHARE:.0%}", *report.share(reached)),
        report.Figure("all plants: fewest that finish", "", f"{lowest:.1%}", len(results)),
        report.Figure("all plants: largest lap gap", "", f"{widest:.2f} %", len(results)),
        report.Figure(
            "flying lap, shorter than the minimal model's policy's", "", middle, len(shorter)
        ),
    ]
    return found, sum(reached) >= TARGET_SHARE * len(matter)


def draw_chart(results: list[dict[str, Any]]) -> bytes:
    """Return the chart as PNG: success and lap gap, a column per plant, a mark per policy."""
    figure = Figure(figsize=(max(7.0, 0.75 * len(results) + 2.0), 6.0), layout="constrained")
    success, gap = figure.subplots(2, 1, sharex=True)
    for place, (name, (label, marker, colour)) in enumerate(POLICIES.items()):
        stages = [stage(result, name) for result in results]
        where = [index + SPREAD * (place - 2) for index in range(len(results))]
        style = {
            "linestyle": "",
            "marker": marker,
            "color": colour,
            "label": label,
            "markersize": 7,
        }
        success.plot(where, [100.0 * one["plant"]["success"] for one in stages], **style)
        gap.plot(where, [min(gap_percent(one), LARGEST_GAP_PERCENT) for one in stages], **style)
    success.set_ylabel("finish 3 laps on the plant (%)")
    success.set_ylim(top=101.0)
    gap.set_ylabel(f"|lap gap| (%), {LARGEST_GAP_PERCENT:g}: more, or no lap")
    gap.axhline(1.0, color="0.7", linewidth=1.0)
    success.axhline(95.0, color="0.7", linewidth=1.0)
    gap.set_xticks(range(len(results)), [result["job"] for result in results])
    gap.set_xlabel("plant")
    for axes in (success, gap):
        axes.grid(axis="y", alpha=0.3)
    figure.legend(*success.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return png_of(figure, DPI)


def write_page(path: Path, results: list[dict[str, Any]], steps: int) -> bool:
    """Write the page and its chart; return whether the target is met."""
    found, is_met = figures(results)
    chart = path.with_suffix(".png")
    write_atomically(chart, draw_chart(results))
    report.fill_page(
        path,
        "loop",
        millions=steps / 1e6,
        figures=report.figures_table(found),
        below=MATTERS_BELOW,
        above_percent=MATTERS_ABOVE_PERCENT,
        chart=chart.name,
        race=race_table(results),
        models=model_table(results),
        cpu_min=sum(result["cpu_s"] for result in results) / 60.0,
    )
    return is_met
