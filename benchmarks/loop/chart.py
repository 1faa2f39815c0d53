"""A chart of the loop: success and lap gap, a column per plant, a mark per policy."""

import io
import math
from typing import Any

from matplotlib.figure import Figure

MARKS = {"before": ("o", "C3"), "after": ("o", "C2"), "refitted_base": ("s", "C0")}
OTHER_MARKS = {"nominal": ("v", "0.5"), "randomised": ("^", "C1")}
LARGEST_GAP_PERCENT = 10.0  # beyond, and where no lap was flown, at the rim
SPREAD = 0.12  # between marks of a column


def draw_chart(results: list[dict[str, Any]], policies: dict[str, str]) -> bytes:
    """Return the chart as PNG; ``results`` as of ``benchmarks.loop.one``, policies: names of stages."""
    figure = Figure(figsize=(max(7.0, 0.75 * len(results) + 2.0), 6.0), layout="constrained")
    success, gap = figure.subplots(2, 1, sharex=True)
    marks = MARKS | OTHER_MARKS
    for place, (name, label) in enumerate(policies.items()):
        stages = [next(one for one in result["stages"] if one["name"] == name) for result in results]
        marker, colour = marks[name]
        where = [index + SPREAD * (place - 2) for index in range(len(results))]
        style = {"linestyle": "", "marker": marker, "color": colour, "label": label, "markersize": 7}
        success.plot(where, [100.0 * one["plant"]["success"] for one in stages], **style)
        gaps = [one["lap_gap_percent"] for one in stages]
        sizes = [math.inf if one is None else abs(one) for one in gaps]
        gap.plot(where, [min(size, LARGEST_GAP_PERCENT) for size in sizes], **style)
    success.set_ylabel("finish 3 laps on the plant (%)")
    gap.set_ylabel(f"|lap gap| (%), {LARGEST_GAP_PERCENT:g}: more, or no lap")
    gap.axhline(1.0, color="0.7", linewidth=1.0)
    success.axhline(95.0, color="0.7", linewidth=1.0)
    gap.set_xticks(range(len(results)), [result["job"] for result in results])
    gap.set_xlabel("plant")
    for axes in (success, gap):
        axes.grid(axis="y", alpha=0.3)
    figure.legend(*success.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    return buffer.getvalue()
