"""Figures of the report: the evidence for each cause, and residuals of the models by regressor."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flytrack_sysid.diagnosis.evidence import After, Against, words_of
from flytrack_sysid.diagnosis.statistics import (
    BLOCK_S,
    FEWEST_ROWS,
    TWO_SIDED_95,
    bin_edges,
    binned_means,
    on_slots,
    step_response,
)
from flytrack_sysid.diagnosis.traces import REGRESSORS, UNITS, Traces
from flytrack_sysid.plots import BLUE, GREY, ORANGE, say

WIDTH_IN, ROW_IN, LEGEND_IN = 8.0, 2.5, 0.9
MOST_COLUMNS = 3
BEFORE_S, AFTER_S = 0.05, 0.3  # shown about a change of a command
FEWEST_SHOWN = 50  # rows
NO_DATA = "not in the log, or too little of it"
# Attitude and velocity are noisy in each row: their change over a piece is known as well as over a step.
PIECE_S, FEWEST_PIECES = 0.2, 5
# Turns are shown in degrees: unit -> unit shown, and factor.
SHOWN = {
    "rad/s": ("deg/s", float(np.rad2deg(1.0))),
    "rad/s²": ("deg/s²", float(np.rad2deg(1.0))),
}
_TURN_AXES = {"x": "roll", "y": "pitch", "z": "yaw"}
MODELS = {"nominal": ("nominal", "0.55"), "base": ("refitted", ORANGE), "extended": ("extended", BLUE)}
RATES = tuple(f"rates_{axis}" for axis in "xyz")
FORCES = tuple(f"force_{axis}" for axis in "xyz")
NUM_REGRESSOR_BINS = 10
ASIDE = 0.012  # of a panel's width, between the models' dots


def _panels(
    title: str, rows: int, columns: int, height_in: float, is_one_scale: bool = False
) -> tuple[Figure, Any]:
    """Return an empty figure of (rows, columns) panels; is_one_scale: of y, for the panels of a row."""
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    figure.suptitle(title, fontsize="large", fontweight="bold", x=0.01, ha="left")
    axes = figure.subplots(rows, columns, squeeze=False, sharey="row" if is_one_scale else False)
    for panel in axes.flat:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(color="0.92", linewidth=0.8)
        panel.set_axisbelow(True)
        panel.tick_params(labelsize="small")
    return figure, axes


def _legend_below(figure: Figure, columns: int = 4) -> None:
    handles, labels = max(
        (panel.get_legend_handles_labels() for panel in figure.axes), key=lambda own: len(own[1])
    )
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize="small")


def _label(residual: str) -> str:
    """Return what a residual is of, with its unit."""
    channel, axis = residual.split("_")[0], residual.split("_")[-1]
    unit = SHOWN.get(UNITS[channel], (UNITS[channel], 1.0))[0]
    if channel == "battery":
        return f"battery voltage ({unit})"
    if channel in ("rates", "attitude"):
        source = "" if channel == "rates" else ", by attitude"
        return f"{_TURN_AXES[axis]} rate{source} ({unit})"
    frame = "world " if "world" in residual else ""
    source = "" if channel == "force" else ", by velocity"
    return f"force {frame}{axis}{source} ({unit})"


def _can_show(traces: Traces, residual: str) -> bool:
    return int(traces.column("extended", residual)[1].sum()) >= FEWEST_SHOWN


def _column(traces: Traces, model: str, residual: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a residual in the unit of its label, and where it counts; both (num_rows,)."""
    values, counts = traces.column(model, residual)
    return values * SHOWN.get(UNITS[residual.split("_")[0]], ("", 1.0))[1], counts


def _regressor(traces: Traces, name: str) -> tuple[np.ndarray, str]:
    """Return a regressor as it is shown, (num_rows,), and its label with unit."""
    label, unit = REGRESSORS[name]
    shown, factor = SHOWN.get(unit, (unit, 1.0))
    return traces.regressors[name] * factor, label if shown == "1" else f"{label} ({shown})"


def _blocks(traces: Traces) -> np.ndarray:
    """Return the number of the second that each row is in, (num_rows,) int."""
    second = traces.slot // max(round(BLOCK_S / traces.step_s), 1)
    return np.unique(second, return_inverse=True)[1]


def _piece_means(columns: Sequence[np.ndarray], traces: Traces, counts: np.ndarray) -> list[np.ndarray]:
    """Return the means of columns over short pieces, over which the noise of changes cancels."""
    piece = traces.slot[counts] // max(round(PIECE_S / traces.step_s), 1)
    number = np.unique(piece, return_inverse=True)[1]
    rows = np.bincount(number)
    return [np.bincount(number, values) / rows for values in columns]


def _draw_against(panel: Axes, traces: Traces, spec: Against, without: str, full: str) -> None:
    regressor, label = _regressor(traces, spec.regressor)
    (left, counts), (rest, _) = (_column(traces, name, spec.residual) for name in (without, full))
    columns = [values[counts] for values in (regressor, left, rest, _blocks(traces))]
    is_change = spec.residual.split("_")[0] in ("attitude", "velocity")
    if is_change:
        columns = _piece_means(columns, traces, counts)
    regressor, left, rest, block = columns
    edges = bin_edges(regressor, fewest=FEWEST_PIECES if is_change else FEWEST_ROWS)
    before, explained, after = (
        binned_means(regressor, values, block.astype(int), edges) for values in (left, left - rest, rest)
    )
    _draw_three(panel, before.at, before.means, before.ends95, explained.means, after.means)
    panel.set_xlabel(label, fontsize="small")


def _draw_after(panel: Axes, traces: Traces, spec: After, without: str, full: str) -> None:
    (left, counts), (rest, _) = (_column(traces, name, spec.residual) for name in (without, full))
    command = traces.regressors[f"command_{spec.stick}"]
    change = np.diff(on_slots(command, traces.slot, np.ones(len(command), bool)), prepend=np.nan)
    if spec.only:
        change = np.where(np.isfinite(change), np.maximum(spec.only * change, 0.0) * spec.only, np.nan)
    before, explained, after = (
        step_response(change, on_slots(values, traces.slot, counts), traces.step_s, -BEFORE_S, AFTER_S)
        for values in (left, left - rest, rest)
    )
    # A row holds what its step led to: lag 0 is one step after the change.
    milliseconds = 1e3 * (before.lags_s + traces.step_s)
    _draw_three(panel, milliseconds, before.values, TWO_SIDED_95 * before.std, explained.values, after.values)
    panel.axvline(0.0, color=GREY, linewidth=0.8)
    which = {0: "step", 1: "rise", -1: "fall"}[spec.only]
    panel.set_xlabel(f"time since a {which} of {spec.stick} (ms)", fontsize="small")


def _draw_three(
    panel: Axes, at: np.ndarray, before: np.ndarray, ends95: np.ndarray, curve: np.ndarray, after: np.ndarray
) -> None:
    panel.axhline(0.0, color=GREY, linewidth=0.8)
    label = "left without the cause, 95 % interval"
    style: dict[str, Any] = {"markersize": 4, "elinewidth": 1.2, "linestyle": "none"}
    panel.errorbar(at, before, ends95, fmt="o", color=ORANGE, label=label, zorder=2, **style)
    panel.plot(at, curve, "-", color="black", linewidth=1.6, label="explained by the cause", zorder=3)
    panel.plot(at, after, "o", mfc="white", mec=BLUE, markersize=4, label="left with the cause", zorder=4)


def draw_cause(
    cause: str, panels: Sequence[Against | After], traces: Traces, without: str, extended: str
) -> Figure:
    """Draw the panels of a cause.

    without, extended: of the models in ``traces``, the extended one without the cause, and with it. The curve
    is the difference between the predictions of the two.
    """
    # Without a sensor, its panel and that of its replacement are the same.
    panels = list(dict.fromkeys(spec._replace(residual=traces.used(spec.residual)) for spec in panels))
    columns = min(len(panels), MOST_COLUMNS) if len(panels) % MOST_COLUMNS != 1 else min(len(panels), 2)
    rows = -(-len(panels) // columns)
    title = words_of(cause)
    figure, axes = _panels(title[0].upper() + title[1:], rows, columns, LEGEND_IN + ROW_IN * rows)
    for panel, spec in zip(axes.flat, panels, strict=True):
        label = _label(spec.residual)
        if not _can_show(traces, spec.residual):
            say(panel, f"{label}:\n{NO_DATA}")
            continue
        if isinstance(spec, Against):
            _draw_against(panel, traces, spec, without, extended)
        else:
            _draw_after(panel, traces, spec, without, extended)
            label = f"{label[:-1]} per unit)"
        panel.set_title(label, fontsize="small", loc="left")
    for panel in axes[:, 0]:
        panel.set_ylabel("measured minus modelled", fontsize="small")
    _legend_below(figure, columns=3)
    return figure


def _models_in(traces: Traces) -> list[str]:
    return [name for name in MODELS if name in traces.residuals]


def _regressors_of(residual: str) -> list[str]:
    """Return what a residual is drawn against: its own stick first."""
    stick = {"rates_x": "roll", "rates_y": "pitch", "rates_z": "yaw"}.get(residual)
    own = f"airspeed_{residual[-1]}" if stick is None else f"applied_{stick}"
    return [own, "speed", "applied_thrust", "position_x", "position_y", "height", "heading"]


def _draw_bins(panel: Axes, traces: Traces, residual: str, name: str) -> None:
    """Draw the means of a residual of all models by bins of a regressor."""
    regressor, label = _regressor(traces, name)
    for number, model in enumerate(_models_in(traces)):
        values, counts = _column(traces, model, residual)
        edges = bin_edges(regressor[counts], NUM_REGRESSOR_BINS)
        found = binned_means(regressor[counts], values[counts], _blocks(traces)[counts], edges)
        words, colour = MODELS[model]
        at = found.at + (number - 1) * ASIDE * (edges[-1] - edges[0])
        style: dict[str, Any] = {"fmt": "o-", "color": colour, "markersize": 3.5, "linewidth": 0.9}
        panel.errorbar(at, found.means, found.ends95, label=words, **style)
    panel.axhline(0.0, color=GREY, linewidth=0.6)
    panel.set_xlabel(label.replace(" (", "\n("), fontsize="x-small")
    panel.tick_params(labelsize="x-small")


def draw_against(traces: Traces, residuals: Sequence[str], title: str) -> Figure:
    """Draw binned means of residuals, a row each, against speed, thrust, stick, place and heading."""
    columns = len(_regressors_of(residuals[0]))
    figure, axes = _panels(title, len(residuals), columns, 6.2, is_one_scale=True)
    for line, residual in zip(axes, residuals, strict=True):
        if not _can_show(traces, residual):
            for panel in line:
                say(panel, NO_DATA)
            continue
        for panel, name in zip(line, _regressors_of(residual), strict=True):
            _draw_bins(panel, traces, residual, name)
        line[0].set_ylabel(_label(traces.used(residual)), fontsize="small")
    _legend_below(figure)
    return figure
