"""The page of the loop: what each policy does on each plant, and whether the extension helped."""

import argparse
import math
import re
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.env_speed import cpu_name, versions
from benchmarks.loop.chart import draw_chart
from flytrack_env.effects import BY_NAME as ALL_EFFECTS
from flytrack_env.files import write_atomically

POLICIES = {
    "before": "minimal model",
    "after": "extended model",
    "refitted_base": "refitted base",
    "nominal": "nominal model",
    "randomised": "randomised, no identification",
}
# Of the policy of the minimal model: where its race holds this, the effect does not matter.
MATTERS_BELOW, MATTERS_ABOVE_PERCENT = 0.80, 3.0
AIM_SUCCESS, AIM_GAP_PERCENT, AIM_SHARE = 0.95, 1.0, 0.9
LITTLE = 0.01  # of success, where less is chance of 256 flights, and of a lap


def stage(result: dict[str, Any], name: str) -> dict[str, Any]:
    """Return one stage of a plant's result."""
    return next(one for one in result["stages"] if one["name"] == name)


def gap_percent(one: dict[str, Any]) -> float:
    """Return the size of a stage's lap gap, %; infinite where the plant saw no lap."""
    gap = one["lap_gap_percent"]
    return math.inf if gap is None else abs(gap)


def lap_s(one: dict[str, Any]) -> float:
    """Return a stage's flying lap on the plant, s; infinite where there was none."""
    value = one["plant"]["flying_lap_s"]
    return math.inf if value is None else value


def does_matter(result: dict[str, Any]) -> bool:
    """Return whether what is hidden spoils the race of the policy of the minimal model."""
    before = stage(result, "before")
    return before["plant"]["success"] < MATTERS_BELOW or gap_percent(before) > MATTERS_ABOVE_PERCENT


def is_reached(result: dict[str, Any]) -> bool:
    """Return whether the extended model's policy races as the aim asks."""
    after = stage(result, "after")
    return after["plant"]["success"] >= AIM_SUCCESS and gap_percent(after) <= AIM_GAP_PERCENT


def where_it_does_not_help(result: dict[str, Any]) -> str | None:
    """Return why the extension is of no use on a plant; None where it is."""
    before, after, base = (stage(result, name) for name in ("before", "after", "refitted_base"))
    if not result["causes"]:
        return "nothing was named"
    if after["plant"]["success"] < before["plant"]["success"] - LITTLE:
        return f"success falls from {before['plant']['success']:.1%} to {after['plant']['success']:.1%}"
    reasons = []
    for name, one in (("the minimal model", before), ("the refitted base", base)):
        is_as_safe = one["plant"]["success"] >= after["plant"]["success"] - LITTLE
        is_as_near = gap_percent(one) <= max(gap_percent(after), AIM_GAP_PERCENT)
        if is_as_safe and is_as_near and lap_s(one) <= (1.0 + LITTLE) * lap_s(after):
            reasons.append(f"{name} is as good")
    return "; ".join(reasons) or None


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


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
    return _table(["plant", "matters", *POLICIES.values()], rows)


def _model_cells(result: dict[str, Any]) -> list[str]:
    errors = [stage(result, name)["errors"] for name in ("before", "refitted_base", "after")]
    one_step = [
        " / ".join(_number(one["one_step_nrmse"].get(channel), ".4f") for one in errors)
        for channel in ("v", "q")
    ]
    return [*one_step, " / ".join(_number(one["position_m"].get("1"), ".3f") for one in errors)]


def model_table(results: list[dict[str, Any]]) -> str:
    """Return what is hidden and named, and the errors of the models on held-out flights."""
    head = ["plant", "hidden", "named", "log", "velocity", "attitude", "free flight of 1 s (m)"]
    rows = [
        [
            result["job"],
            result["hidden"],
            ", ".join(result["causes"]) or "nothing",
            f"{result['race_log_s']:g} s",
            *_model_cells(result),
        ]
        for result in results
    ]
    return _table(head, rows)


def verdict(results: list[dict[str, Any]]) -> tuple[str, bool]:
    """Return whether the aim is met, as text and as truth; without a plant that matters it is."""
    matter = [result for result in results if does_matter(result)]
    reached = [result for result in matter if is_reached(result)]
    lost = [result["job"] for result in matter if not is_reached(result)]
    text = (
        f"Of {len(results)} plants, what is hidden matters on {len(matter)}: the policy of the minimal model "
        f"finishes less than {MATTERS_BELOW:.0%}, or its lap differs by more than "
        f"{MATTERS_ABOVE_PERCENT:g} % from the simulator's. On **{len(reached)} of {len(matter)}** the "
        f"policy of the extended model reaches at least {AIM_SUCCESS:.0%} with a lap gap of at most "
        f"{AIM_GAP_PERCENT:g} % (aim: 9 of 10)"
    )
    text += f"; not on {', '.join(lost)}." if lost else "."
    return text + of_all(results), len(reached) >= AIM_SHARE * len(matter)


def of_all(results: list[dict[str, Any]]) -> str:
    """Return a sentence on all plants, whether what is hidden matters or not."""
    if not results:
        return ""
    pairs = [(stage(result, "before"), stage(result, "after")) for result in results]
    lowest = min(after["plant"]["success"] for _, after in pairs)
    widest = max(gap_percent(after) for _, after in pairs)
    shares = [lap_s(after) / lap_s(before) for before, after in pairs if math.isfinite(lap_s(before))]
    text = f" On all {len(results)}: at least {lowest:.1%} and a lap gap of at most {widest:.2f} %"
    if shares:
        text += (
            f"; where both fly laps, its flying lap is {100.0 * (1.0 - median(shares)):.1f} % shorter than "
            f"that of the minimal model's policy (median; {100.0 * (1.0 - max(shares)):+.1f} % to "
            f"{100.0 * (1.0 - min(shares)):+.1f} %)"
        )
    return f"{text}."


def names_not_there(result: dict[str, Any]) -> list[str]:
    """Return the effects that were named on a hidden plant and are not in it."""
    hidden = re.findall(r"(\w+)\(", result["hidden"])
    return [name for name in result["causes"] if name in ALL_EFFECTS and hidden and name not in hidden]


PAGE = """# The loop: does the diagnosis make better policies?

`python -m benchmarks.loop --plants {plants} --seed {seed} --steps {steps}`. Every policy: {millions:g} M
environment steps of the default recipe, one training seed; 256 perturbed starts x 3 laps. Logs as of common
sensors; the policies see the plant's state. The diagnosis was shown flights of the minimal model's policy and
the excitation that the minimal model was fitted to.

{verdict}

![Success and lap gap by plant and policy]({chart})

## The race

Success on the plant (in the simulator that the policy learnt in), mean flying lap on the plant, and how much
longer that is than in the simulator. Lap times are of laps that were completed.

{race}
## The models

On flights of the minimal model's policy from other starts, which no fit and no diagnosis saw: minimal /
refitted base / extended. Velocity and attitude: error of one step over the measured change, the sensors'
noise in it. Free flight: median error of position. Log: how long the flights lasted that were diagnosed.

{models}
Effects that were named and are not in the plant: {strangers}. Base parameters (`tau_roll`, `thrust_curve`)
are not counted: the minimal model had bent them.

## Where the extension does not help

{useless}
{cpu_min:.1f} CPU min on these plants. {machine}.
"""


def write_page(
    path: Path, results: list[dict[str, Any]], arguments: argparse.Namespace, wall_s: float
) -> bool:
    """Write the page and its chart, print the verdict; return whether the aim is met."""
    text, is_met = verdict(results)
    print(text)
    chart = path.with_suffix(".png")
    write_atomically(chart, draw_chart(results, POLICIES))
    useless = [(result["job"], why) for result in results if (why := where_it_does_not_help(result))]
    strangers = [(result["job"], names) for result in results if (names := names_not_there(result))]
    page = PAGE.format(
        plants=arguments.plants,
        seed=arguments.seed,
        steps=arguments.steps,
        millions=arguments.steps / 1e6,
        verdict=text,
        chart=chart.name,
        race=race_table(results),
        models=model_table(results),
        useless="".join(f"- {job}: {why}.\n" for job, why in useless) or "On none of these plants.\n",
        strangers="; ".join(f"plant {job}: {', '.join(names)}" for job, names in strangers) or "none",
        cpu_min=sum(result["cpu_s"] for result in results) / 60.0,
        machine=f"{cpu_name()}; {', '.join(f'{name} {number}' for name, number in versions().items())}",
    )
    write_atomically(path, page.encode())
    print(f"written: {path}, {chart}; {wall_s / 60.0:.1f} min, without jobs that were done before")
    return is_met
