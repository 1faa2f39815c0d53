"""The plot that convicts a cause: what is left without it, what it explains of that, what is left with it."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flytrack_sysid.diagnosis.bins import BLOCK_S, FEWEST_ROWS, binned, edges_of
from flytrack_sysid.diagnosis.evidence import After, Against, words_of
from flytrack_sysid.diagnosis.traces import REGRESSORS, UNITS, Traces
from flytrack_sysid.diagnosis.whiteness import BANDS, on_slots, response
from flytrack_sysid.plots import BLUE, GREY, ORANGE, say

WIDTH_IN, ROW_IN, LEGEND_IN = 8.0, 2.5, 0.9
MOST_COLUMNS = 3
BEFORE_S, AFTER_S = 0.05, 0.3  # shown about a change of a command
FEWEST_SHOWN = 50  # rows
NOTHING = "not in the log, or too little of it"
# Attitude and velocity are noisy in each row: the change over a piece is known as well as that over a step.
PIECE_S, FEWEST_PIECES = 0.2, 5
# People think of turns in degrees: unit -> unit shown, and factor.
SHOWN = {
    "rad/s": ("deg/s", float(np.rad2deg(1.0))),
    "rad/s²": ("deg/s²", float(np.rad2deg(1.0))),
}
_TURN_AXES = {"x": "roll", "y": "pitch", "z": "yaw"}


def panels_of(
    title: str, rows: int, columns: int, height_in: float, is_one_scale: bool = False
) -> tuple[Figure, np.ndarray]:
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


def legend_below(figure: Figure, columns: int = 4) -> None:
    """Put one legend for all panels below them, where it hides nothing."""
    handles, labels = max(
        (panel.get_legend_handles_labels() for panel in figure.axes), key=lambda own: len(own[1])
    )
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize="small")


def label_of(residual: str) -> str:
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


def can_show(traces: Traces, residual: str) -> bool:
    """Return whether enough rows of a residual count to show anything."""
    return int(traces.column("extended", residual)[1].sum()) >= FEWEST_SHOWN


def scaled(residual: str, values: np.ndarray) -> np.ndarray:
    """Return values of a residual in the unit of ``label_of``."""
    unit = UNITS[residual.split("_")[0]]
    return values * SHOWN.get(unit, (unit, 1.0))[1]


def regressor_of(traces: Traces, name: str) -> tuple[np.ndarray, str]:
    """Return a regressor as it is shown, (num_rows,), and its label with unit."""
    label, unit = REGRESSORS[name]
    shown, factor = SHOWN.get(unit, (unit, 1.0))
    return traces.regressors[name] * factor, label if shown == "1" else f"{label} ({shown})"


def block_of(traces: Traces) -> np.ndarray:
    """Return the second that each row is in, counted on, (num_rows,) int: rows of one may hang together."""
    second = traces.slot // max(round(BLOCK_S / traces.step_s), 1)
    return np.unique(second, return_inverse=True)[1]


def _averaged(columns: Sequence[np.ndarray], traces: Traces, counts: np.ndarray) -> list[np.ndarray]:
    """Return the means of columns over short pieces, over which the noise of changes cancels."""
    piece = traces.slot[counts] // max(round(PIECE_S / traces.step_s), 1)
    number = np.unique(piece, return_inverse=True)[1]
    rows = np.bincount(number)
    return [np.bincount(number, values) / rows for values in columns]


def _draw_against(panel: Axes, traces: Traces, spec: Against, names: tuple[str, str]) -> None:
    regressor, label = regressor_of(traces, spec.regressor)
    (left, counts), (rest, _) = (traces.column(name, spec.residual) for name in names)
    left, rest, block = scaled(spec.residual, left), scaled(spec.residual, rest), block_of(traces)
    columns = [values[counts] for values in (regressor, left, rest, block)]
    is_change = spec.residual.split("_")[0] in ("attitude", "velocity")
    if is_change:
        columns = _averaged(columns, traces, counts)
    regressor, left, rest, block = columns
    edges = edges_of(regressor, fewest=FEWEST_PIECES if is_change else FEWEST_ROWS)
    before, explained, after = (
        binned(regressor, values, block.astype(int), edges) for values in (left, left - rest, rest)
    )
    _draw_three(panel, before.at, before.means, before.ends95, explained.means, after.means)
    panel.set_xlabel(label, fontsize="small")


def _draw_after(panel: Axes, traces: Traces, spec: After, names: tuple[str, str]) -> None:
    (left, counts), (rest, _) = (traces.column(name, spec.residual) for name in names)
    command = traces.regressors[f"command_{spec.stick}"]
    change = np.diff(on_slots(command, traces.slot, np.ones(len(command), bool)), prepend=np.nan)
    if spec.only:
        change = np.where(np.isfinite(change), np.maximum(spec.only * change, 0.0) * spec.only, np.nan)
    found = [
        response(
            change,
            scaled(spec.residual, on_slots(values, traces.slot, counts)),
            traces.step_s,
            -BEFORE_S,
            AFTER_S,
        )
        for values in (left, left - rest, rest)
    ]
    before, explained, after = found
    # A row holds what its step led to: lag 0 is one step after the change.
    milliseconds = 1e3 * (before.lags_s + traces.step_s)
    _draw_three(panel, milliseconds, before.values, BANDS[95] * before.std, explained.values, after.values)
    panel.axvline(0.0, color=GREY, linewidth=0.8)
    which = {0: "step", 1: "rise", -1: "fall"}[spec.only]
    panel.set_xlabel(f"time since a {which} of {spec.stick} (ms)", fontsize="small")


def _draw_three(
    panel: Axes, at: np.ndarray, before: np.ndarray, ends95: np.ndarray, curve: np.ndarray, after: np.ndarray
) -> None:
    panel.axhline(0.0, color=GREY, linewidth=0.8)
    style = {"markersize": 4, "elinewidth": 1.2, "linestyle": "none"}
    label = "left without the cause, 95 % interval"
    panel.errorbar(at, before, ends95, fmt="o", color=ORANGE, label=label, zorder=2, **style)
    panel.plot(at, curve, "-", color="black", linewidth=1.6, label="what the cause explains", zorder=3)
    panel.plot(at, after, "o", mfc="white", mec=BLUE, markersize=4, label="left with the cause", zorder=4)


def draw_cause(
    cause: str, panels: Sequence[Against | After], traces: Traces, without: str, extended: str
) -> Figure:
    """Draw the panels of a cause.

    without, extended: of the models in ``traces``, the extended one less the cause, and itself. The curve is
    the difference between what the two say of each row.
    """
    # Without a sensor, its panel and that of what stands in for it are the same.
    panels = list(dict.fromkeys(spec._replace(residual=traces.used(spec.residual)) for spec in panels))
    columns = min(len(panels), MOST_COLUMNS) if len(panels) % MOST_COLUMNS != 1 else min(len(panels), 2)
    rows = -(-len(panels) // columns)
    title = words_of(cause)
    height_in = LEGEND_IN + ROW_IN * rows
    figure, axes = panels_of(title[0].upper() + title[1:], rows, columns, height_in)
    for panel, spec in zip(axes.flat, panels, strict=True):
        if not can_show(traces, spec.residual):
            say(panel, f"{label_of(spec.residual)}:\n{NOTHING}")
            continue
        draw = _draw_against if isinstance(spec, Against) else _draw_after
        draw(panel, traces, spec, (without, extended))
        label = label_of(spec.residual)
        title = label if isinstance(spec, Against) else f"{label[:-1]} per unit)"
        panel.set_title(title, fontsize="small", loc="left")
    for panel in axes[:, 0]:
        panel.set_ylabel("measured less said", fontsize="small")
    legend_below(figure, columns=3)
    return figure
