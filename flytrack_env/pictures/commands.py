"""What was commanded, what the drone applied of it, speed and battery over time."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flytrack_env.flown_race import STEP_S
from flytrack_env.pictures.flight import PASSED, Flight
from flytrack_env.pictures.style import BLUE, GREEN, GREY, ORANGE, literal, new_figure, plain, with_room
from flytrack_env.state import APPLIED_ACTION, BATTERY, Action

SECOND_IN, WIDTHS_IN, HEIGHT_IN = 0.9, (10.0, 24.0), 8.0
HEIGHTS = (1.0, 1.0, 1.0, 1.0, 1.0, 0.7)
MARKS = {
    "gate": Line2D([], [], color="0.7", linewidth=0.9, label="gate passed"),
    "lap": Line2D([], [], color=GREEN, linewidth=1.8, label="lap complete"),
    "failure": Line2D([], [], color="black", linewidth=1.2, linestyle="--", label="gate touched or missed"),
}


def draw_commands(flight: Flight) -> Figure:
    """Return four sticks, commanded against applied, speed and battery; gates passed and laps as marks."""
    times = flight.times_s
    # The last step, after the last state, may have met a gate.
    end_s = max(times[-1], *(one.time_s for one in flight.meetings), STEP_S)
    width = float(np.clip(SECOND_IN * times[-1], *WIDTHS_IN))
    figure = new_figure(width, HEIGHT_IN)
    panels = figure.subplots(len(HEIGHTS), 1, sharex=True, height_ratios=HEIGHTS)
    for panel, name, command, applied in zip(
        panels, Action._fields, flight.commands.T, flight.states[:, APPLIED_ACTION].T, strict=False
    ):
        _draw_stick(panel, times, command, applied)
        panel.set_ylabel(f"{name} stick")
    panels[4].plot(times, flight.speeds_m_s, color=BLUE)
    panels[4].set(ylabel="speed (m/s)", ylim=(0.0, None))
    panels[5].plot(times, flight.states[:, BATTERY], color=BLUE)
    panels[5].set(ylabel="battery (V)", xlabel="time (s)", xlim=(0.0, end_s))
    for panel in panels:
        plain(panel)
        _mark(panel, flight)
    _label(panels[0], flight, width)
    figure.align_ylabels(panels)
    sticks = panels[3].get_legend_handles_labels()[0]
    figure.legend(handles=[*sticks, *MARKS.values()], loc="outside lower center", ncols=5, frameon=False)
    figure.suptitle(literal(f"{flight.title}\n{flight.laps_in_words}"), fontsize="medium")
    return figure


def _draw_stick(panel: Axes, times: np.ndarray, command: np.ndarray, applied: np.ndarray) -> None:
    """Draw one stick; a command holds for a step, from its state on. NaN is a gap."""
    panel.plot(times, command, color=ORANGE, linewidth=1.0, drawstyle="steps-post", label="commanded")
    panel.plot(times, applied, color=BLUE, linewidth=1.6, label="applied")
    if np.isnan(applied).all():
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8}
        said = "applied: not in the file"
        panel.text(0.01, 0.08, said, color=GREY, transform=panel.transAxes, bbox=box)
    # Commands outside of the sticks' range are shown where they are.
    reach = max(1.0, float(np.abs(command).max()))
    panel.set_ylim(-1.08 * reach, 1.08 * reach)


def _mark(panel: Axes, flight: Flight) -> None:
    """Draw a line where a gate was passed, a bold one where a lap ended, a dashed one at failures."""
    marks = [(one.time_s, "lap" if one.lap else "gate") for one in flight.race.passes]
    marks += [(one.time_s, "failure") for one in flight.meetings if one.outcome != PASSED]
    for time_s, kind in marks:
        mark = MARKS[kind]
        style: dict[str, Any] = {
            "color": mark.get_color(),
            "linewidth": mark.get_linewidth(),
            "ls": mark.get_linestyle(),
        }
        panel.axvline(time_s, zorder=0.5, **style)


def _label(panel: Axes, flight: Flight, width_in: float) -> None:
    """Write the gates' ids and the lap times above a panel, where there is room for them."""
    ids = [(one.time_s, str(flight.track.gates[one.gate].id)) for one in flight.meetings]
    laps = [(one.time_s, f"lap {one.lap}: {one.lap_time_s:.3f} s") for one in flight.race.passes if one.lap]
    failures = [(one.time_s, one.outcome) for one in flight.meetings if one.outcome != PASSED]
    inch_s = flight.times_s[-1] / width_in
    texts = [(*label, 3, GREY) for label in with_room(ids, inch_s)]
    for time_s, text in with_room([*laps, *failures], inch_s):
        texts.append((time_s, text, 13, GREEN if (time_s, text) in laps else "black"))
    for time_s, text, above, colour in texts:
        panel.annotate(
            text, (time_s, 1.0), (0, above), xycoords=panel.get_xaxis_transform(),
            textcoords="offset points", ha="center", fontsize="small", color=colour,
        )  # fmt: skip
