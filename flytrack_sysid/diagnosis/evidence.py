"""Causes in plain words, and the plots that show them: residuals against regressors."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import ThrustScale
from flytrack_env.pictures.drawing import new_figure, plain
from flytrack_env.toml_file import parse_toml, read_text
from flytrack_sysid.diagnosis.result import DRIFT, TWO_SIDED_95
from flytrack_sysid.diagnosis.traces import REGRESSORS, UNITS, Traces
from flytrack_sysid.inference.parameters import parameter_values, with_values
from flytrack_sysid.inference.score_test import ALL_BASE_CAUSES
from flytrack_sysid.plots import BLUE, GREY, ORANGE, say

WIDTH_IN, ROW_IN, LEGEND_IN = 8.0, 2.5, 0.9  # of a picture, inches
MAX_COLUMNS = 3  # of plots in a picture
EXTENDED = "extended"  # name of the extended model in traces
MIN_SHOWN = 50  # rows
NO_DATA = "not in the log, or too little of it"
NUM_BINS = 15  # of a regressor's range
SHOWN_PERCENTILES = (0.5, 99.5)  # of the regressor: outliers would compress all other rows
# Numbers in a bin: rows or pieces that are wanted, and rows without which there is no scatter.
WANTED_ROWS, WANTED_PIECES, MIN_ROWS = 20, 5, 2
BLOCK_S = 1.0  # rows further apart than this count as independent
MIN_BLOCKS = 10  # the scatter of fewer blocks is too uncertain
# Attitude and velocity are noisy in each row: their change over a piece has the same noise as over
# a step.
PIECE_S = 0.2
_TURN_AXES = {"x": "roll", "y": "pitch", "z": "yaw"}


class Panel(NamedTuple):
    """A plot of the means of a residual by bins of a regressor, names as in ``traces``."""

    residual: str
    regressor: str


class Evidence(NamedTuple):
    """The words and plots of a cause.

    Attributes:
        words: the cause as a noun in plain words.
        panels: plots that show the cause.
        reading: how the plots show it.
    """

    words: str
    panels: tuple[Panel, ...]
    reading: str


def _read_evidence() -> dict[str, Evidence]:
    """Read the evidence of causes by name from ``evidence.toml``."""
    rows: dict[str, dict[str, Any]] = {}
    result = {}
    for name, entry in parse_toml(read_text(Path(__file__).with_suffix(".toml"))).items():
        rows[name] = row = rows.get(entry.get("like", ""), {}) | entry
        plots = [
            plot.replace("*", axis)
            for plot in row["plots"]
            for axis in ("xyz" if "*" in plot else "x")
        ]
        panels = tuple(Panel(*plot.split(" over ")) for plot in plots)
        result[name] = Evidence(row["words"], panels, row["reading"])
    return result


EVIDENCE = _read_evidence()


def without(extended: ModelParameters, nominal: ModelParameters, cause: str) -> ModelParameters:
    """Return a model without one cause: its effect or base parameters are nominal.

    Raises:
        KeyError: no cause of that name.
    """
    if cause == "thrust_scale" and all(
        type(effect) is not ThrustScale for effect in extended.effects
    ):
        cause = "thrust_curve"  # the scale is one factor between two curves, not an effect
    if cause not in ALL_BASE_CAUSES:
        return extended.with_effects(nominal.effect(cause))
    before = parameter_values(nominal)
    return with_values(extended, {name: before[name] for name in ALL_BASE_CAUSES[cause]})


def words_of(cause: str) -> str:
    """Return a cause in plain words; its name if there are none."""
    if cause == DRIFT:
        return (
            "a drift of the thrust, as while motors warm up; fly again with warm motors and a full "
            "battery"
        )
    return EVIDENCE[cause].words if cause in EVIDENCE else cause.replace("_", " ")


def list_words(causes: Sequence[str]) -> str:
    """Return causes in plain words, as a list in a sentence."""
    return "; ".join(words_of(cause) for cause in causes)


class Binned(NamedTuple):
    """Means by bin, (num_bins,) each; only bins with two rows or more.

    Attributes:
        at: means of the regressor.
        means: means of the values.
        ends95: half-widths of the 95 % intervals.
    """

    at: np.ndarray
    means: np.ndarray
    ends95: np.ndarray


def bin_edges(regressor: np.ndarray, fewest: int = WANTED_ROWS) -> np.ndarray:
    """Return the edges of bins over a regressor, (at most NUM_BINS + 1,).

    Bins have equal widths. A bin with fewer than ``fewest`` rows is joined with the next ones.
    """
    low, high = np.percentile(regressor, SHOWN_PERCENTILES)
    even = np.linspace(low, max(high, low + np.finfo(np.float32).eps), NUM_BINS + 1)
    edges, rows = [even[0]], 0
    for count, edge in zip(np.histogram(regressor, even)[0], even[1:], strict=True):
        rows += int(count)
        if rows >= fewest:
            edges.append(edge)
            rows = 0
    # Remaining rows join the last bin.
    return even[[0, -1]] if len(edges) == 1 else np.array([*edges[:-1], even[-1]])


def binned_means(
    regressor: np.ndarray, values: np.ndarray, block: np.ndarray, edges: np.ndarray
) -> Binned:
    """Return means of values by bins of a regressor.

    The interval is from the scatter of sums over blocks (K.-Y. Liang, S. Zeger, 1986). If a bin has
    few blocks, it is at least that of independent rows.

    Args:
        regressor: (num_rows,).
        values: (num_rows,).
        block: index of the block of each row, from 0, (num_rows,) int. Rows of one block may be
            correlated.
        edges: edges of the bins, (num_bins + 1,).
    """
    num_bins = len(edges) - 1
    bin_index = np.searchsorted(edges, regressor, side="right") - 1
    inside = (bin_index >= 0) & (bin_index < num_bins)
    bin_index, values, block = bin_index[inside], values[inside], block[inside]
    rows = np.bincount(bin_index, minlength=num_bins)
    divisors = np.maximum(rows, 1)
    means = np.bincount(bin_index, values, minlength=num_bins) / divisors
    centres = np.bincount(bin_index, regressor[inside], minlength=num_bins) / divisors
    deviations = values - means[bin_index]
    by_row = np.bincount(bin_index, deviations**2, minlength=num_bins)
    num_blocks = int(block.max(initial=-1)) + 1
    cell, cells = bin_index * num_blocks + block, num_bins * num_blocks
    sums = np.bincount(cell, deviations, minlength=cells).reshape(num_bins, -1)
    num_used_blocks = (np.bincount(cell, minlength=cells).reshape(num_bins, -1) > 0).sum(axis=1)
    by_block = (sums**2).sum(axis=1)
    variance = np.where(num_used_blocks >= MIN_BLOCKS, by_block, np.maximum(by_block, by_row))
    kept = rows >= MIN_ROWS
    return Binned(centres[kept], means[kept], (TWO_SIDED_95 * np.sqrt(variance) / divisors)[kept])


def _blocks(traces: Traces, length_s: float) -> np.ndarray:
    """Return the index of each row's block of some length, (num_rows,) int."""
    block = traces.slot // max(round(length_s / traces.step_s), 1)
    return np.unique(block, return_inverse=True)[1]


def _in_degrees(unit: str) -> tuple[str, float]:
    """Return the unit in which a unit is shown, and the factor to it: degrees for radians."""
    return (
        (unit.replace("rad/", "deg/"), float(np.rad2deg(1.0)))
        if unit.startswith("rad/")
        else (unit, 1.0)
    )


def _label(residual: str) -> str:
    """Return the name of a residual's quantity, with its unit."""
    channel, axis = residual.split("_")[0], residual.split("_")[-1]
    unit = _in_degrees(UNITS[channel])[0]
    if channel == "battery":
        return f"battery voltage ({unit})"
    source = {"attitude": ", by attitude", "velocity": ", by velocity"}.get(channel, "")
    if channel in ("rates", "attitude"):
        return f"{_TURN_AXES[axis]} rate{source} ({unit})"
    if axis == "along":
        return f"force along the direction of flight{source} ({unit})"
    frame = "world " if "world" in residual else ""
    return f"force {frame}{axis}{source} ({unit})"


def _draw_panel(axes: Any, traces: Traces, panel: Panel, without: str) -> None:
    channel = panel.residual.split("_")[0]
    (without_cause, counts), (with_cause, _) = (
        traces.column(name, panel.residual) for name in (without, EXTENDED)
    )
    label, unit = REGRESSORS[panel.regressor]
    unit, factor = _in_degrees(unit)
    scale = _in_degrees(UNITS[channel])[1]
    columns = [
        values[counts]
        for values in (
            factor * traces.regressors[panel.regressor],
            scale * without_cause,
            scale * with_cause,
        )
    ]
    block, fewest = _blocks(traces, BLOCK_S)[counts], WANTED_ROWS
    if channel in ("attitude", "velocity"):
        piece = np.unique(_blocks(traces, PIECE_S)[counts], return_inverse=True)[1]
        rows, fewest = np.bincount(piece), WANTED_PIECES
        *columns, block = [np.bincount(piece, values) / rows for values in (*columns, block)]
    regressor, without_cause, with_cause = columns
    edges = bin_edges(regressor, fewest=fewest)
    before, explained, after = (
        binned_means(regressor, values, block.astype(int), edges)
        for values in (without_cause, without_cause - with_cause, with_cause)
    )
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    style: dict[str, Any] = {
        "markersize": 4,
        "elinewidth": 1.2,
        "linestyle": "none",
        "color": ORANGE,
    }
    dots = "left without the cause, 95 % interval"
    axes.errorbar(before.at, before.means, before.ends95, fmt="o", label=dots, zorder=2, **style)
    axes.plot(
        before.at, explained.means, "k-", linewidth=1.6, label="explained by the cause", zorder=3
    )
    rings: dict[str, Any] = {"mfc": "white", "mec": BLUE, "markersize": 4, "zorder": 4}
    axes.plot(before.at, after.means, "o", label="left with the cause", **rings)
    axes.set_xlabel(label if unit == "1" else f"{label} ({unit})", fontsize="small")


def draw_cause(
    cause: str, panels: Sequence[Panel], traces: Traces, without: str, when: str = ""
) -> Figure:
    """Draw the panels of a cause.

    The curve is the difference between the predictions of the extended models without and with the
    cause.

    Args:
        without: name in ``traces`` of the extended model without the cause.
        when: when the cause acts, for the title.
    """
    # Without a sensor, its panel and that of its replacement are the same.
    panels = list(
        dict.fromkeys(panel._replace(residual=traces.used(panel.residual)) for panel in panels)
    )
    columns = (
        min(len(panels), MAX_COLUMNS) if len(panels) % MAX_COLUMNS != 1 else min(len(panels), 2)
    )
    rows = -(-len(panels) // columns)
    figure = new_figure(WIDTH_IN, LEGEND_IN + ROW_IN * rows)
    title = words_of(cause)
    title = title[0].upper() + title[1:] + when
    figure.suptitle(title, fontsize="large", fontweight="bold", x=0.01, ha="left")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes, panel in zip(grid.flat, panels, strict=True):
        plain(axes).tick_params(labelsize="small")
        label = _label(panel.residual)
        if traces.column(EXTENDED, panel.residual)[1].sum() < MIN_SHOWN:
            say(axes, f"{label}:\n{NO_DATA}")
            continue
        _draw_panel(axes, traces, panel, without)
        axes.set_title(label, fontsize="small", loc="left")
    for axes in grid[:, 0]:
        axes.set_ylabel("measured minus modelled", fontsize="small")
    entries = max(
        (axes.get_legend_handles_labels() for axes in figure.axes),
        key=lambda legend: len(legend[1]),
    )
    figure.legend(*entries, loc="outside lower center", ncols=3, frameon=False, fontsize="small")
    return figure
