"""Pictures of a diagnosis: errors of the models, residuals over time and against regressors, whiteness."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flytrack_sysid.diagnosis.bins import binned, edges_of
from flytrack_sysid.diagnosis.conviction import (
    NOTHING,
    block_of,
    can_show,
    label_of,
    legend_below,
    panels_of,
    regressor_of,
    scaled,
)
from flytrack_sysid.diagnosis.result import Errors
from flytrack_sysid.diagnosis.traces import Traces
from flytrack_sysid.diagnosis.whiteness import (
    BANDS,
    Correlation,
    autocorrelation,
    cross_correlation,
    on_slots,
)
from flytrack_sysid.plots import BLUE, GREEN, GREY, ORANGE, say

# The models in the order of a diagnosis: name, words, colour.
MODELS = {
    "nominal": ("nominal", "0.55"),
    "base": ("refitted", ORANGE),
    "extended": ("extended", BLUE),
}
FLOOR = ("noise floor", GREEN)
_ERROR_KEYS = {"nominal": "nominal", "refitted_base": "base", "extended": "extended", "noise_floor": None}
CHANNEL_WORDS = {
    "p": "position",
    "v": "velocity",
    "q": "attitude",
    "w": "body rates",
    "a": "acceleration",
    "f": "specific force",
    "v_bat": "battery",
}
RATES = tuple(f"rates_{axis}" for axis in "xyz")
FORCES = tuple(f"force_{axis}" for axis in "xyz")
MOST_TIME_BINS, LEAST_TIME_BIN_S = 200, 0.25
NUM_REGRESSOR_BINS = 10
MARKER = 3.5
ASIDE = 0.012  # of a panel's width: models stand beside each other, so that none hides another


def error_style(name: str) -> tuple[str, str]:
    """Return words and colour of a model in ``Diagnosis.error``."""
    key = _ERROR_KEYS.get(name)
    return FLOOR if key is None else MODELS[key]


def _draw_bars(panel: Axes, errors: Mapping[str, Mapping[str, float]], labels: Mapping[str, str]) -> None:
    """Draw a group of bars per key, a bar per model; missing ones and nan are left out."""
    width = 0.8 / max(len(errors), 1)
    for number, (model, values) in enumerate(errors.items()):
        words, colour = error_style(model)
        place = np.arange(len(labels)) + (number - (len(errors) - 1) / 2.0) * width
        heights = np.array([values.get(key, np.nan) for key in labels])
        panel.bar(place, heights, width, color=colour, label=words)
    panel.set_xticks(np.arange(len(labels)), list(labels.values()))
    panel.grid(axis="x", visible=False)


def keys_of(errors: Sequence[Mapping[str, float]]) -> list[str]:
    """Return all keys of some mappings, in the order in which they come up."""
    return list(dict.fromkeys(key for one in errors for key in one))


def draw_errors(error: Mapping[str, Errors]) -> Figure:
    """Draw how errors shrink from the nominal model to the noise floor, by channel and in free flight."""
    figure, axes = panels_of("Errors on the held-out part", 1, 2, 3.3)
    one_step = {name: one.one_step_nrmse for name, one in error.items()}
    keys = keys_of(list(one_step.values()))
    _draw_bars(axes[0, 0], one_step, {key: CHANNEL_WORDS.get(key, key) for key in keys})
    axes[0, 0].set_title("one step, 1 is as bad as saying the mean", fontsize="small", loc="left")
    axes[0, 0].set_ylabel("NRMSE")
    axes[0, 0].tick_params(axis="x", rotation=20)
    free = {name: one.position_m for name, one in error.items()}
    keys = keys_of(list(free.values()))
    _draw_bars(axes[0, 1], free, {key: f"{key} s" for key in keys})
    axes[0, 1].set_title("position error in free flight, rms", fontsize="small", loc="left")
    axes[0, 1].set_ylabel("m")
    legend_below(figure)
    return figure


def _models_in(traces: Traces) -> list[str]:
    return [name for name in MODELS if name in traces.residuals]


def draw_over_time(traces: Traces) -> Figure:
    """Draw the means of residuals over short pieces of time, before and after."""
    figure, axes = panels_of("Residuals over time", 4, 2, 8.0)
    elapsed = traces.regressors["elapsed"]
    span = float(elapsed[-1] - elapsed[0])
    count = int(np.clip(span / LEAST_TIME_BIN_S, 1, MOST_TIME_BINS))
    edges = np.linspace(elapsed[0], elapsed[-1] + traces.step_s, count + 1)
    names = [name for pair in zip(RATES, FORCES, strict=True) for name in pair] + ["battery"]
    for panel, residual in zip(axes.flat, names, strict=False):
        if not can_show(traces, residual):
            say(panel, f"{label_of(residual)}:\n{NOTHING}")
            continue
        for model in _models_in(traces):
            values, counts = traces.column(model, residual)
            values = scaled(residual, values)[counts]
            found = binned(elapsed[counts], values, block_of(traces)[counts], edges)
            words, colour = MODELS[model]
            panel.plot(found.at, found.means, color=colour, linewidth=0.9, label=words)
        panel.axhline(0.0, color=GREY, linewidth=0.6)
        panel.set_title(label_of(traces.used(residual)), fontsize="small", loc="left")
    axes.flat[-1].set_axis_off()
    for panel in (axes[3, 0], axes[2, 1]):
        panel.set_xlabel("time (s)", fontsize="small")
    legend_below(figure)
    return figure


def _regressors_of(residual: str) -> list[str]:
    """Return what a residual is drawn against: its own stick first."""
    stick = {"rates_x": "roll", "rates_y": "pitch", "rates_z": "yaw"}.get(residual)
    own = f"airspeed_{residual[-1]}" if stick is None else f"applied_{stick}"
    return [own, "speed", "applied_thrust", "position_x", "position_y", "height", "heading"]


def _draw_bins(panel: Axes, traces: Traces, residual: str, name: str) -> None:
    """Draw the means of a residual of all models by bins of a regressor."""
    regressor, label = regressor_of(traces, name)
    block = block_of(traces)
    for number, model in enumerate(_models_in(traces)):
        values, counts = traces.column(model, residual)
        edges = edges_of(regressor[counts], NUM_REGRESSOR_BINS)
        found = binned(regressor[counts], scaled(residual, values)[counts], block[counts], edges)
        words, colour = MODELS[model]
        aside = (number - 1) * ASIDE * (edges[-1] - edges[0])
        style = {"fmt": "o-", "color": colour, "markersize": MARKER, "linewidth": 0.9}
        panel.errorbar(found.at + aside, found.means, found.ends95, label=words, **style)
    panel.axhline(0.0, color=GREY, linewidth=0.6)
    panel.set_xlabel(label.replace(" (", "\n("), fontsize="x-small")
    panel.tick_params(labelsize="x-small")


def draw_against(traces: Traces, residuals: Sequence[str], title: str) -> Figure:
    """Draw binned means of residuals, a row each, against speed, thrust, stick, place and heading."""
    columns = len(_regressors_of(residuals[0]))
    figure, axes = panels_of(title, len(residuals), columns, 6.2, is_one_scale=True)
    for line, residual in zip(axes, residuals, strict=True):
        if not can_show(traces, residual):
            for panel in line:
                say(panel, NOTHING)
            continue
        for panel, name in zip(line, _regressors_of(residual), strict=True):
            _draw_bins(panel, traces, residual, name)
        line[0].set_ylabel(label_of(traces.used(residual)), fontsize="small")
    legend_below(figure)
    return figure


def _draw_correlation(panel: Axes, found: Correlation, words: str, colour: str) -> None:
    milliseconds = 1e3 * found.lags_s
    shown = found.lags_s != 0.0 if found.lags_s[0] == 0.0 else slice(None)  # 1 at lag 0 would dwarf the rest
    panel.plot(
        milliseconds[shown], found.values[shown], ".-", color=colour, label=words, markersize=3, linewidth=0.8
    )


def _draw_bands(panel: Axes, found: Correlation) -> None:
    for percent, shade in ((99, "0.9"), (95, "0.8")):
        ends = BANDS[percent] * found.std
        label = f"{percent} % of noise"
        panel.fill_between(1e3 * found.lags_s, -ends, ends, color=shade, linewidth=0.0, label=label, zorder=0)


def _grid(traces: Traces, model: str, residual: str) -> np.ndarray:
    values, counts = traces.column(model, residual)
    return on_slots(values, traces.slot, counts)


def autocorrelations(traces: Traces, residual: str) -> dict[str, Correlation]:
    """Return the autocorrelation of a residual of each of the three models; none if little of it counts."""
    models = _models_in(traces) if can_show(traces, residual) else []
    return {model: autocorrelation(_grid(traces, model, residual), traces.step_s) for model in models}


def cross_correlations(traces: Traces, residual: str, stick: str) -> dict[str, Correlation]:
    """Return the cross-correlation of a residual of each of the three models with a command; likewise."""
    command = traces.regressors[f"command_{stick}"]
    command = on_slots(command, traces.slot, np.ones(len(command), bool))
    models = _models_in(traces) if can_show(traces, residual) else []
    return {
        model: cross_correlation(command, _grid(traces, model, residual), traces.step_s) for model in models
    }


def _draw_correlations(panel: Axes, found: Mapping[str, Correlation], title: str) -> None:
    """Draw correlations of models, and the bands of the extended one."""
    if not found:
        say(panel, f"{title}:\n{NOTHING}")
        return
    for model, one in found.items():
        _draw_correlation(panel, one, *MODELS[model])
    _draw_bands(panel, found["extended"])
    panel.set_title(title, fontsize="small", loc="left")


def draw_whiteness(traces: Traces) -> Figure:
    """Draw autocorrelations of residuals, with the bands that white noise stays within."""
    figure, axes = panels_of("Is what is left white? Autocorrelation of residuals", 2, 3, 5.4)
    for panel, residual in zip(axes.flat, (*RATES, *FORCES), strict=True):
        title = label_of(traces.used(residual)).split(" (")[0]
        _draw_correlations(panel, autocorrelations(traces, residual), title)
    for panel in axes[-1]:
        panel.set_xlabel("lag (ms)", fontsize="small")
    legend_below(figure, columns=5)
    return figure


def draw_independence(traces: Traces) -> Figure:
    """Draw cross-correlations of residuals with the commands, with bands of independence."""
    figure, axes = panels_of("Is what is left independent of the commands?", 2, 2, 5.4)
    pairs = dict(zip((*RATES, FORCES[2]), ("roll", "pitch", "yaw", "thrust"), strict=True))
    for panel, (residual, stick) in zip(axes.flat, pairs.items(), strict=True):
        title = f"{label_of(traces.used(residual)).split(' (')[0]} with the {stick} command"
        _draw_correlations(panel, cross_correlations(traces, residual, stick), title)
        panel.axvline(0.0, color=GREY, linewidth=0.8)
    for panel in axes[-1]:
        panel.set_xlabel("residual after the command (ms)", fontsize="small")
    legend_below(figure, columns=5)
    return figure
