"""The figures of a flight: the course from above, heights, gates from the front, commands."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Rectangle

from flytrack_env.flown_race import DRONE_RADIUS_M, STEP_S
from flytrack_env.pictures import drawing
from flytrack_env.pictures.flight import PASSED, Flight, Meeting
from flytrack_env.scene import (
    BLUE,
    GREEN,
    ORANGE,
    PAPER_COLOURS,
    PAPER_FRAME,
    PAPER_OPENING,
    gates_of,
)
from flytrack_env.state import APPLIED_ACTION, BATTERY, POSITION, Action
from flytrack_env.tracks import Gate, Track, build_course

# From above.
# The view's longer side; room beside it, and above and below.
PANEL_IN, BESIDE_IN, TITLE_IN = 7.0, 1.6, 1.4
NARROWEST = 0.35  # of the longer side
MARGIN_SHARE = 0.03
TOP_VIEW = [0, 1]
LINES = ("-", "--", ":", "-.")

# Widths grow with the flight, within limits.
WIDTHS_IN = (10.0, 24.0)
METRE_IN, SIDE_IN = 0.05, 3.6  # width of a metre flown; height of the side view
GATE_IN, GATES_TITLE_IN = 1.25, 0.5
SECOND_IN, COMMANDS_IN = 0.9, 8.0  # width of a second; height of the commands
MARKS: dict[str, Any] = {
    "gate passed": {"color": "0.7", "lw": 0.9},
    "lap complete": {"color": GREEN, "lw": 1.8},
    "not passed": {"color": "black", "ls": "--"},
}
AROUND = 1.12  # of a gate's half frame, or of the farthest meeting


def draw_top(flight: Flight) -> Figure:
    """Return the course from above, the path coloured by speed, lap times in the title."""
    figure, axes = _course([flight], BESIDE_IN)
    points, speeds = flight.states[:, POSITION][:, :2], flight.speeds_m_s
    top = drawing.HEADROOM * max(float(speeds.max()), 1.0)
    lines = drawing.draw_path(axes, points, speeds[:-1], top, 2.2)
    failures = np.reshape(
        [meeting.pos_w[:2] for meeting in flight.meetings if meeting.outcome != PASSED], (-1, 2)
    )
    axes.plot(*failures.T, "X", color="black", markersize=8, markeredgecolor="white", zorder=5)
    marks = (
        ("start", points[0], BLUE, "o"),
        (drawing.escape(flight.ended), points[-1], ORANGE, "X"),
    )
    for text, point, colour, marker in marks:
        axes.plot(
            *point,
            marker,
            color=colour,
            markersize=9,
            markeredgecolor="white",
            label=text,
            zorder=6,
        )
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    axes.set_title(drawing.escape(f"{flight.title}\n{flight.laps_text}"), fontsize="medium")
    figure.colorbar(lines, ax=axes, label="speed (m/s)", shrink=0.8)
    return figure


def draw_comparison(flights: Sequence[Flight]) -> Figure:
    """Return the course from above with a path per flight, each in a colour of its own.

    Raises:
        ValueError: flights on several tracks.
    """
    tracks = sorted({flight.track.name for flight in flights})
    if len(tracks) != 1:
        raise ValueError(f"flights: found tracks {tracks}, expected flights on one")
    texts = [
        drawing.escape(f"{flight.name}\n{flight.laps_text}\n{flight.ended}") for flight in flights
    ]
    longest = max(len(line) for text in texts for line in text.splitlines())
    figure, axes = _course(flights, BESIDE_IN + drawing.LETTER_IN * longest)
    styles = itertools.cycle(itertools.product(LINES, PAPER_COLOURS))
    for flight, text, (line, colour) in zip(flights, texts, styles, strict=False):
        points = flight.states[:, POSITION][:, :2]
        axes.plot(*points.T, line, color=colour, linewidth=1.5, label=text)
        axes.plot(*points[0], "o", color=colour, markeredgecolor="white", zorder=6)
        axes.plot(*points[-1], "X", color=colour, markersize=9, markeredgecolor="white", zorder=6)
    axes.set_title(
        drawing.escape(f"{len(flights)} flights on {flights[0].track.name}"), fontsize="medium"
    )
    figure.legend(loc="outside right upper", frameon=False, fontsize="small", labelspacing=1.0)
    return figure


def _course(flights: Sequence[Flight], beside_in: float) -> tuple[Figure, Axes]:
    """Return a figure with bounds and gates, wide enough for flights that leave the bounds."""
    track = flights[0].track
    ends = np.array([track.bounds_low, track.bounds_high])[:, :2]
    points = np.concatenate([*(flight.states[:, POSITION][:, :2] for flight in flights), ends])
    low, high = points.min(axis=0), points.max(axis=0)
    margin = MARGIN_SHARE * (high - low).max()
    low, high = low - margin, high + margin
    width, height = PANEL_IN * np.maximum((high - low) / (high - low).max(), NARROWEST)
    figure = drawing.new_figure(width + beside_in, height + TITLE_IN)
    axes = figure.add_subplot()
    axes.add_patch(
        Rectangle(ends[0], *(ends[1] - ends[0]), fill=False, edgecolor="0.6", linestyle="--")
    )
    drawing.draw_gates(axes, track, TOP_VIEW)
    drawing.label_from_above(axes, track)
    axes.set(
        aspect="equal",
        xlim=(low[0], high[0]),
        ylim=(low[1], high[1]),
        xlabel="x (m)",
        ylabel="y (m)",
    )
    return figure, axes


def draw_side(flight: Flight) -> Figure:
    """Return height over distance, coloured by speed, above the gates as the drone saw them."""
    width = float(np.clip(METRE_IN * flight.distances_m[-1], *WIDTHS_IN))
    num_rows = math.ceil(len(flight.track.gates) * GATE_IN / width)
    num_columns = math.ceil(len(flight.track.gates) / num_rows)
    gates_in = num_rows * (GATE_IN + 0.3) + GATES_TITLE_IN
    figure = drawing.new_figure(width, SIDE_IN + gates_in)
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(SIDE_IN, gates_in)).ravel()
    top = drawing.HEADROOM * max(float(flight.speeds_m_s.max()), 1.0)
    _draw_height(upper, flight, top)
    _draw_fronts(lower, flight, top, (num_rows, num_columns))
    figure.suptitle(drawing.escape(f"{flight.title}\n{flight.laps_text}"), fontsize="medium")
    return figure


def _draw_height(figure: SubFigure, flight: Flight, top: float) -> None:
    """Draw the path's height, and a bar for every gate where its plane was met."""
    axes = drawing.plain(figure.add_subplot())
    heights_m = flight.states[:, POSITION][:, 2]
    points = np.stack([flight.distances_m, heights_m], axis=1)
    lines = drawing.draw_path(axes, points, flight.speeds_m_s[:-1], top, 2.4)
    lines.set_zorder(4)
    half_heights_m = _half_heights_m(flight.track)
    for meeting in flight.meetings:
        _draw_bar(axes, flight.track.gates[meeting.gate], meeting, half_heights_m[meeting.gate])
    floor_m = flight.track.bounds_low[2]
    axes.axhline(floor_m, color="0.3", linewidth=1.5)
    axes.plot(*points[0], "o", color=BLUE, markersize=8, markeredgecolor="white", zorder=6)
    edges_m = [gate.position[2] + 0.5 * gate.frame for gate in flight.track.gates]
    highest, lowest = max(*edges_m, float(heights_m.max())), min(floor_m, float(heights_m.min()))
    room = 0.05 * (highest - lowest)
    # The last step, after the last state, may have met a gate.
    end_m = max(points[-1, 0], *(meeting.distance_m for meeting in flight.meetings), 1.0)
    axes.set(xlim=(-0.01 * end_m, 1.01 * end_m), ylim=(lowest - room, highest + 4.0 * room))
    axes.set(xlabel="distance flown (m)", ylabel="height z (m)")
    figure.colorbar(lines, ax=axes, label="speed (m/s)", pad=0.01)


def _half_heights_m(track: Track) -> np.ndarray:
    """Return half the height of each gate's frame and opening, (num_gates, 2), m.

    A gate that leans is lower.
    """
    gates = gates_of(build_course(track))
    return 0.5 * np.stack(
        [np.ptp(corners[..., 2], axis=1) for corners in (gates.outer, gates.inner)], axis=1
    )


def _draw_bar(axes: Axes, gate: Gate, meeting: Meeting, half_heights_m: np.ndarray) -> None:
    """Draw a gate as a grey bar with a red opening, and a cross where it was not passed."""
    x, z = meeting.distance_m, gate.position[2]
    half_frame, half_opening = half_heights_m
    for half, colour, width in (
        (half_frame, PAPER_FRAME, 3.2),
        (half_opening, "white", 3.2),
        (half_opening, PAPER_OPENING, 1.2),
    ):
        axes.plot([x, x], [z - half, z + half], color=colour, linewidth=width, zorder=2)
    if meeting.outcome != PASSED:
        axes.plot(
            x,
            meeting.pos_w[2],
            "X",
            color="black",
            markersize=10,
            markeredgecolor="white",
            zorder=6,
        )
    text = str(gate.id) if meeting.outcome == PASSED else f"{meeting.outcome}\n{gate.id}"
    style: Any = {"color": PAPER_OPENING, "ha": "center", "weight": "bold", "fontsize": "small"}
    axes.annotate(text, (x, z + half_frame), (0, 3), textcoords="offset points", **style)


def _draw_fronts(figure: SubFigure, flight: Flight, top: float, shape: tuple[int, int]) -> None:
    """Draw every gate from the front, in flying order."""
    panels = figure.subplots(*shape, squeeze=False).ravel()
    for panel in panels:
        panel.set_axis_off()
    for index, (panel, gate) in enumerate(zip(panels, flight.track.gates, strict=False)):
        _draw_front(
            panel, gate, [meeting for meeting in flight.meetings if meeting.gate == index], top
        )
    figure.suptitle(
        "Gates as the drone approaches them, and how often it passed of how often it met them. "
        f"Dashed: free for a drone of {DRONE_RADIUS_M:g} m radius.\n"
        "Dots: passed; crosses: frame touched, or missed. Colours: speed.",
        fontsize="small",
    )


def _draw_front(panel: Axes, gate: Gate, meetings: list[Meeting], top: float) -> None:
    """Draw one gate and where the drone met its plane, coloured by speed."""
    free = gate.opening - 2.0 * DRONE_RADIUS_M
    edges = ((gate.frame, "0.85", "-", PAPER_FRAME), (gate.opening, "white", "-", PAPER_OPENING))
    for edge, face, line, colour in (*edges, (free, "none", "--", PAPER_OPENING)):
        corner = (-0.5 * edge, -0.5 * edge)
        panel.add_patch(
            Rectangle(corner, edge, edge, facecolor=face, edgecolor=colour, linestyle=line)
        )
    for is_pass, marker, size in ((True, "o", 36), (False, "X", 110)):
        shown = [meeting for meeting in meetings if (meeting.outcome == PASSED) is is_pass]
        panel.scatter(
            [meeting.right_m for meeting in shown],
            [meeting.up_m for meeting in shown],
            size,
            [meeting.speed_m_s for meeting in shown],
            marker=marker,
            edgecolors="black",
            linewidths=0.6,
            vmin=0.0,
            vmax=top,
        )
    reach = AROUND * max(
        [0.5 * gate.frame, *(max(abs(meeting.right_m), abs(meeting.up_m)) for meeting in meetings)]
    )
    num_passed = sum(meeting.outcome == PASSED for meeting in meetings)
    panel.set(aspect="equal", xlim=(-reach, reach), ylim=(-reach, reach))
    panel.set_title(f"gate {gate.id}: {num_passed} of {len(meetings)}", fontsize="small")


def draw_commands(flight: Flight) -> Figure:
    """Return a figure of the four sticks, commanded and applied, speed and battery over time.

    Lines mark gates, laps and failures.
    """
    times_s = STEP_S * np.arange(len(flight.states))
    width = float(np.clip(SECOND_IN * times_s[-1], *WIDTHS_IN))
    figure = drawing.new_figure(width, COMMANDS_IN)
    panels = figure.subplots(6, 1, sharex=True)
    for stick, name in enumerate(Action._fields):
        # A command holds for a step, from its state on.
        command, applied = flight.commands[:, stick], flight.states[:, APPLIED_ACTION][:, stick]
        panels[stick].plot(
            times_s, command, color=ORANGE, drawstyle="steps-post", label="commanded"
        )
        panels[stick].plot(times_s, applied, color=BLUE, linewidth=1.6, label="applied")
        panels[stick].set_ylabel(f"{name} stick")
    panels[4].plot(times_s, flight.speeds_m_s, color=BLUE)
    panels[5].plot(times_s, flight.states[:, BATTERY], color=BLUE)
    panels[4].set_ylabel("speed (m/s)")
    panels[5].set(ylabel="battery (V)", xlabel="time (s)")
    marks = [
        (gate_pass.time_s, "lap complete" if gate_pass.lap else "gate passed")
        for gate_pass in flight.race.passes
    ]
    marks += [
        (meeting.time_s, "not passed") for meeting in flight.meetings if meeting.outcome != PASSED
    ]
    for panel in panels:
        drawing.plain(panel)
        for time_s, mark in marks:
            panel.axvline(time_s, label=mark, zorder=0.5, **MARKS[mark])
    handles, labels = panels[3].get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    figure.legend(once.values(), once.keys(), loc="outside lower center", ncols=5, frameon=False)
    figure.suptitle(drawing.escape(f"{flight.title}\n{flight.laps_text}"), fontsize="medium")
    return figure
