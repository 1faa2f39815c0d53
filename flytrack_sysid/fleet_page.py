"""The page of a fleet: Markdown, and a picture of all flights."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from flytrack_env.messages import quote_name
from flytrack_env.pictures.drawing import png_of
from flytrack_sysid.fleet import (
    CONTRADICTS,
    DIAGNOSED,
    FAILED,
    MIN_NAMED,
    UNREADABLE,
    Change,
    Flight,
    names_of,
)
from flytrack_sysid.page import write_report

PAGE, PICTURE = "fleet.md", "fleet.png"
COLOURS = {  # of the picture; causes have others
    "nothing found": "#d5e8d4",
    "unexplained": "#fff2b3",
    CONTRADICTS: "#bdbdbd",
    UNREADABLE: "#4d4d4d",
    FAILED: "#000000",
}
MAX_CAUSES = 7  # with a colour of their own; the eighth of matplotlib's is grey
CELL_INCHES, MARGIN_INCHES = 0.32, 3.0
Results = dict[str, dict[str, Any]]


def standing(diagnosed: Sequence[dict[str, Any]], changed: set[str]) -> list[str]:
    """Return causes that most flights of a craft name, but for those that changed."""
    counts = Counter(
        cause["effect"] for result in diagnosed for cause in result["diagnosis"]["causes"]
    )
    return [
        f"{effect} ({count} of {len(diagnosed)} flights)"
        for effect, count in sorted(counts.items())
        if count >= MIN_NAMED * len(diagnosed) and effect not in changed
    ]


def describe_change(change: Change) -> str:
    """Return a change in words."""
    values = [
        f"{effect} ({', '.join(f'{name} {_value(value)}' for name, value in parameters.items())})"
        for effect, parameters in change.causes.items()
    ]
    what = "unknown what" if change.failure else " and ".join(values) or "no cause"
    verb = "ends" if change.has_ended else "begins"
    before = change.before or "no diagnosed flight"
    text = f"{what} {verb} with flight {change.flight}, {change.since} (before: {before})"
    text += f"; the comparison failed: {change.failure}" if change.failure else ""
    return f"{text}; noted: {change.note}" if change.note else text


def _value(value: dict[str, Any]) -> str:
    low, high = value["ci95"]
    interval = "" if low is None or high is None else f" [{low:.3g}, {high:.3g}]"
    return f"{value['value']:.3g}{interval} {value['unit']}".strip()


def _row(word: str) -> str:
    return word.replace("|", "\\|").replace("\n", " ")


def format_page(flights: Sequence[Flight], results: Results, changes: Sequence[Change]) -> str:
    """Return the page in Markdown: changes, craft, and the logs that were not diagnosed."""
    crafts = list(dict.fromkeys(flight.craft for flight in flights))
    states = [results[flight.name]["state"] for flight in flights]
    counts = (
        f"{states.count(DIAGNOSED)} diagnosed, {states.count(CONTRADICTS)} that contradict "
        f"themselves, {states.count(UNREADABLE)} that cannot be read, {states.count(FAILED)} whose "
        "diagnosis failed: the next call tries again"
    )
    lines = [
        "# Fleet",
        "",
        f"{len(flights)} logs of {len(crafts)} craft: {counts}.",
        "",
        f"![Every flight]({PICTURE})",
        "",
        "## What changed",
        "",
    ]
    lines += [f"- **{_row(one.craft)}**: {_row(describe_change(one))}" for one in changes]
    lines += [] if changes else ["Nothing that single flights and a comparison show alike."]
    lines += [
        "",
        "## Craft",
        "",
        "| craft | model | flights | in most flights |",
        "|---|---|---|---|",
    ]
    for craft in crafts:
        own = [flight for flight in flights if flight.craft == craft]
        diagnosed = [results[one.name] for one in own if results[one.name]["state"] == DIAGNOSED]
        changed = {effect for one in changes if one.craft == craft for effect in one.causes}
        model = "nominal" if own[0].model is None else Path(own[0].model).name
        causes = ", ".join(standing(diagnosed, changed)) or "nothing"
        counted = f"{len(diagnosed)} of {len(own)} diagnosed"
        lines.append(f"| {_row(craft)} | {model} | {counted} | {causes} |")
    failed = [flight for flight in flights if results[flight.name]["state"] != DIAGNOSED]
    if failed:
        lines += ["", "## Not diagnosed", "", "| log | state | why |", "|---|---|---|"]
    for flight in failed:
        result = results[flight.name]
        reason = result["reason"].replace(flight.path, Path(flight.path).name)
        lines.append(f"| {_row(quote_name(flight.name))} | {result['state']} | {_row(reason)} |")
    return "\n".join(lines) + "\n"


def draw_fleet(flights: Sequence[Flight], results: Results, changes: Sequence[Change]) -> Figure:
    """Return a picture with a row a craft and a cell a flight: what was found, and what changed."""
    crafts = list(dict.fromkeys(flight.craft for flight in flights))
    own = {craft: [one for one in flights if one.craft == craft] for craft in crafts}
    named = [effect for change in changes for effect in change.causes]
    for flight in flights:
        if results[flight.name]["state"] == DIAGNOSED:
            named += sorted(names_of(results[flight.name]))
    effects = sorted(set(named), key=lambda effect: -named.count(effect))[:MAX_CAUSES]
    colours = {name: f"C{number}" for number, name in enumerate(effects)}
    columns = max(map(len, own.values()))
    size = (MARGIN_INCHES + CELL_INCHES * columns + 2.0, 1.2 + CELL_INCHES * max(len(crafts), 8))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    for row, craft in enumerate(crafts):
        for column, flight in enumerate(own[craft]):
            _draw_cell(axes, (column, row), results[flight.name], colours)
        files = [Path(flight.path).name for flight in own[craft]]
        for change in (one for one in changes if one.craft == craft and one.causes):
            x = files.index(change.since) - 0.5
            axes.plot([x, x], [row - 0.5, row + 0.5], color="black", linewidth=3)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(len(crafts) - 0.5, -0.5), xlabel="flight")
    axes.set_yticks(range(len(crafts)), crafts)
    axes.set_xticks(range(0, columns, max(columns // 20, 1)))
    axes.set_xticklabels([str(int(tick) + 1) for tick in axes.get_xticks()])
    labels = {**COLOURS, **colours, "another cause": "#8c6bb1"}
    patches = [Patch(facecolor=colour, edgecolor="grey", label=n) for n, colour in labels.items()]
    axes.legend(handles=patches, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    axes.set_title("Every flight; a bar marks where a cause begins or ends")
    return figure


def _draw_cell(axes: Any, corner: tuple[int, int], result: dict[str, Any], colours: Any) -> None:
    """Draw a flight as a square, divided among its causes."""
    shades = [COLOURS.get(result["state"], "")]
    if result["state"] == DIAGNOSED:
        effects = [cause["effect"] for cause in result["diagnosis"]["causes"]]
        is_flagged = result["diagnosis"]["unexplained"]["flagged"]
        empty = COLOURS["unexplained" if is_flagged else "nothing found"]
        shades = [colours.get(effect, "#8c6bb1") for effect in effects] or [empty]
    height = 0.9 / len(shades)
    for number, shade in enumerate(shades):
        bottom = (corner[0] - 0.45, corner[1] - 0.45 + number * height)
        axes.add_patch(matplotlib.patches.Rectangle(bottom, 0.9, height, facecolor=shade))


def write_fleet(
    out: Path, flights: Sequence[Flight], results: Results, changes: Sequence[Change]
) -> list[Path]:
    """Write the page and its picture; return their paths."""
    page = format_page(flights, results, changes).encode()
    return write_report(out, {PAGE: page, PICTURE: png_of(draw_fleet(flights, results, changes))})
