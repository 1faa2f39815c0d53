"""The page of the loop's benchmark: how each policy does on each plant, and whether the extension helped."""

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
AIM_SUCCESS, AIM_GAP_PERCENT, AIM_SHARE = 0.95, 1.0, 0.9
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
    """Return whether the extended model's policy meets the aim."""
    after = stage(result, "after")
    return after["plant"]["success"] >= AIM_SUCCESS and gap_percent(after) <= AIM_GAP_PERCENT


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
        cells = [[_number(one["one_step_nrmse"].get(channel), ".4f") for one in errors] for channel in "vq"]
        cells.append([_number(one["position_m"].get("1"), ".3f") for one in errors])
        names = ", ".join(result["causes"]) or "nothing"
        log = f"{result['race_log_s']:g} s"
        rows.append([result["job"], result["hidden"], names, log, *map(" / ".join, cells)])
    return report.table("plant | hidden | named | log | velocity | attitude | free flight of 1 s (m)", rows)


def verdict(results: list[dict[str, Any]]) -> tuple[str, bool]:
    """Return the verdict as text, and whether the aim is met; without a plant that matters it is."""
    matter = [result for result in results if does_matter(result)]
    reached = [result for result in matter if is_reached(result)]
    lost = [result["job"] for result in matter if not is_reached(result)]
    text = (
        f"The hidden effects matter on {len(matter)} of {len(results)} plants: the minimal model's policy "
        f"finishes less than {MATTERS_BELOW:.0%}, or its lap differs by more than "
        f"{MATTERS_ABOVE_PERCENT:g} % from the simulator's. On **{len(reached)} of {len(matter)}** the "
        f"policy of the extended model reaches at least {AIM_SUCCESS:.0%} with a lap gap of at most "
        f"{AIM_GAP_PERCENT:g} % (aim: 9 of 10)"
    )
    text += f"; not on {', '.join(lost)}." if lost else "."
    return text + (summary_of_all(results) if results else ""), len(reached) >= AIM_SHARE * len(matter)


def summary_of_all(results: list[dict[str, Any]]) -> str:
    """Return a sentence on all plants, whether the hidden effects matter or not."""
    pairs = [(stage(result, "before"), stage(result, "after")) for result in results]
    lowest = min(after["plant"]["success"] for _, after in pairs)
    widest = max(gap_percent(after) for _, after in pairs)
    laps = [tuple(one["plant"]["flying_lap_s"] for one in pair) for pair in pairs]
    shorter = [100.0 * (1.0 - after / before) for before, after in laps if before and after]
    text = f" On all {len(results)}: at least {lowest:.1%} and a lap gap of at most {widest:.2f} %"
    if shorter:
        text += (
            f"; where both fly laps, its flying lap is {median(shorter):.1f} % shorter than that of the "
            f"minimal model's policy (median; {min(shorter):+.1f} % to {max(shorter):+.1f} %)"
        )
    return f"{text}."


def draw_chart(results: list[dict[str, Any]]) -> bytes:
    """Return the chart as PNG: success and lap gap, a column per plant, a mark per policy."""
    figure = Figure(figsize=(max(7.0, 0.75 * len(results) + 2.0), 6.0), layout="constrained")
    success, gap = figure.subplots(2, 1, sharex=True)
    for place, (name, (label, marker, colour)) in enumerate(POLICIES.items()):
        stages = [stage(result, name) for result in results]
        where = [index + SPREAD * (place - 2) for index in range(len(results))]
        style = {"linestyle": "", "marker": marker, "color": colour, "label": label, "markersize": 7}
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
    """Write the page and its chart; return whether the aim is met."""
    text, is_met = verdict(results)
    chart = path.with_suffix(".png")
    write_atomically(chart, draw_chart(results))
    report.fill_page(
        path,
        "loop",
        millions=steps / 1e6,
        verdict=text,
        chart=chart.name,
        race=race_table(results),
        models=model_table(results),
        cpu_min=sum(result["cpu_s"] for result in results) / 60.0,
    )
    return is_met
