"""Figures of a validation, in the colours of ``flytrack_env.scene``."""

from collections.abc import Sequence
from functools import partial

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flytrack_env.pictures import drawing
from flytrack_env.pictures.drawing import new_figure, plain
from flytrack_env.scene import BLUE, GREEN, GREY, ORANGE
from flytrack_sysid.prediction_errors import ThrustError
from flytrack_sysid.steps import AXES, StepResponse

png_of = partial(drawing.png_of, dpi=150)
WIDTH_IN, EMPTY_HEIGHT_IN = 7.0, 1.2


def _figure(title: str, rows: int, height_in: float) -> tuple[Figure, np.ndarray]:
    figure = new_figure(WIDTH_IN, height_in)
    figure.suptitle(title, fontsize="large", fontweight="bold")
    axes = figure.subplots(rows, 1, squeeze=False)
    for panel in axes.flat:
        plain(panel)
    return figure, axes


def _empty(title: str, why: str) -> Figure:
    """Return a low figure with the reason why there is nothing to show."""
    figure, panels = _figure(title, 1, EMPTY_HEIGHT_IN)
    say(panels[0, 0], why)
    return figure


def say(axes: Axes, why: str) -> None:
    """Write the reason why a panel shows nothing into it."""
    axes.set_axis_off()
    axes.text(
        0.5, 0.5, why, ha="center", va="center", color=GREY, transform=axes.transAxes, wrap=True
    )


def _label(panel: Axes, x: str, y: str) -> None:
    """Set the labels of a panel, and show its legend."""
    panel.set(xlabel=x, ylabel=y)
    panel.legend(fontsize="small", frameon=False)


def draw_steps(steps: Sequence[StepResponse]) -> Figure:
    """Draw measured and modelled responses to the clearest commanded steps, a panel per axis."""
    title = "Response to commanded steps"
    if not steps:
        return _empty(title, "no clear commanded step of roll, pitch or yaw is judged")
    figure, panels = _figure(title, len(AXES), 8.0)
    for panel, axis in zip(panels[:, 0], AXES, strict=True):
        axis_steps = [step for step in steps if step.axis == axis]
        if not axis_steps:
            say(panel, f"{axis}: no clear commanded step")
            continue
        for colour, step in zip((BLUE, ORANGE, GREEN), axis_steps, strict=False):
            change = f"{step.command_before:+.2f} to {step.command_after:+.2f}"
            label = f"stick {change} at {step.time_s:.2f} s"
            milliseconds = 1e3 * step.since_step
            panel.plot(milliseconds, np.rad2deg(step.measured), color=colour, label=label)
            panel.plot(milliseconds, np.rad2deg(step.modelled), "--", color="black", linewidth=1.2)
        panel.plot([], [], "--", color="black", linewidth=1.2, label="model, flying freely")
        panel.axvline(0.0, color=GREY, linewidth=0.8)
        is_last = axis == AXES[-1]
        _label(panel, "time since the command (ms)" if is_last else "", f"{axis} rate (deg/s)")
    return figure


def draw_thrust(thrust: ThrustError | None) -> Figure:
    """Draw the thrust error over applied action and voltage."""
    if thrust is None:
        return _empty("Thrust", "not judged: it needs v_bat, and f, or a with q")
    figure, panels = _figure("Thrust", 1, 4.5)
    heat = panels[0, 0]
    limit = max(float(np.nanmax(np.abs(thrust.mean_n))), np.finfo(float).tiny)
    heat.grid(False)
    heat.set_facecolor("0.9")
    image = heat.pcolormesh(
        thrust.action_edges,
        thrust.voltage_edges,
        np.ma.masked_invalid(thrust.mean_n),
        cmap=matplotlib.colormaps["PuOr_r"],
        vmin=-limit,
        vmax=limit,
    )
    figure.colorbar(image, ax=heat, label="measured minus modelled (N)")
    heat.set_title("mean error; grey: not flown", fontsize="medium", loc="left")
    heat.set(xlabel="applied thrust action (stick, after the lag)", ylabel="battery (V)")
    return figure
