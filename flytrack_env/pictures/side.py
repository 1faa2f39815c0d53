"""Height over the distance flown, and every gate from the front with where the drone met it."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Rectangle

from flytrack_env.flown_race import DRONE_RADIUS_M
from flytrack_env.pictures.course_view import FRAME_COLOUR, HEADROOM, OPENING_COLOUR, draw_path
from flytrack_env.pictures.flight import PASSED, Flight, Meeting
from flytrack_env.pictures.style import BLUE, literal, new_figure, plain, with_room
from flytrack_env.state import POSITION
from flytrack_env.tracks import Gate, Track, build_course

METRE_IN, WIDTHS_IN, HEIGHT_IN = 0.05, (10.0, 24.0), 3.6
GATE_IN, GATES_TITLE_IN = 1.25, 0.5
MOST_LABELLED = 3
AROUND = 1.12  # of a gate's half frame, or of the farthest meeting


def draw_side(flight: Flight) -> Figure:
    """Return height over distance, coloured by speed, above the gates as the drone saw them."""
    width = float(np.clip(METRE_IN * flight.distances_m[-1], *WIDTHS_IN))
    num_rows = math.ceil(len(flight.track.gates) * GATE_IN / width)
    num_columns = math.ceil(len(flight.track.gates) / num_rows)
    gates_in = num_rows * (GATE_IN + 0.3) + GATES_TITLE_IN
    figure = new_figure(width, HEIGHT_IN + gates_in)
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(HEIGHT_IN, gates_in)).ravel()
    top = HEADROOM * max(float(flight.speeds_m_s.max()), 1.0)
    _draw_height(upper, flight, top, width)
    _draw_fronts(lower, flight, top, (num_rows, num_columns))
    figure.suptitle(literal(f"{flight.title}\n{flight.laps_in_words}"), fontsize="medium")
    return figure


def _draw_height(figure: SubFigure, flight: Flight, top: float, width_in: float) -> None:
    """Draw the path's height, and a bar for every gate where its plane was met."""
    axes = plain(figure.add_subplot())
    heights_m = flight.states[:, POSITION][:, 2]
    points = np.stack([flight.distances_m, heights_m], axis=1)
    lines = draw_path(axes, points, flight.speeds_m_s[:-1], top, 2.4)
    lines.set_zorder(4)
    for meeting in flight.meetings:
        _draw_bar(axes, flight, meeting)
    _label_bars(axes, flight, width_in)
    floor_m = flight.track.bounds_low[2]
    axes.axhline(floor_m, color="0.3", linewidth=1.5)
    axes.plot(*points[0], "o", color=BLUE, markersize=8, markeredgecolor="white", zorder=6)
    edges = [gate.position[2] + 0.5 * gate.frame for gate in flight.track.gates]
    highest = max(*edges, float(heights_m.max()))
    lowest = min(floor_m, float(heights_m.min()))
    room = 0.05 * (highest - lowest)
    axes.set_ylim(lowest - room, highest + 4.0 * room)
    # The last step, after the last state, may have met a gate.
    end_m = max(points[-1, 0], *(meeting.distance_m for meeting in flight.meetings), 1.0)
    axes.set_xlim(-0.01 * end_m, 1.01 * end_m)
    axes.set(xlabel="distance flown (m)", ylabel="height z (m)")
    figure.colorbar(lines, ax=axes, label="speed (m/s)", pad=0.01)


def _draw_bar(axes: Axes, flight: Flight, meeting: Meeting) -> None:
    """Draw a gate's frame as a grey bar with its opening in red, and a cross where it was not passed."""
    gate, x = flight.track.gates[meeting.gate], meeting.distance_m
    z, upwards = gate.position[2], _upwards(flight.track, meeting.gate)
    half_frame, half_opening = (0.5 * edge * upwards for edge in (gate.frame, gate.opening))
    for half, colour, width in (
        (half_frame, FRAME_COLOUR, 3.2),
        (half_opening, "white", 3.2),
        (half_opening, OPENING_COLOUR, 1.2),
    ):
        axes.plot([x, x], [z - half, z + half], color=colour, linewidth=width, zorder=2)
    if meeting.outcome != PASSED:
        axes.plot(x, meeting.pos_w[2], "X", color="black", markersize=10, markeredgecolor="white", zorder=6)


def _upwards(track: Track, index: int) -> float:
    """Return the height of a gate over its edge: 1 if it stands upright."""
    gates = build_course(track).gates
    return float(abs(np.asarray(gates.up.z)[index]) + abs(np.asarray(gates.left().z)[index]))


def _label_bars(axes: Axes, flight: Flight, width_in: float) -> None:
    """Write above the bars the gates' ids, and what failed, where there is room."""
    inch_m = flight.distances_m[-1] / width_in
    ids = [(one.distance_m, str(flight.track.gates[one.gate].id)) for one in flight.meetings]
    failures = [(one.distance_m, one.outcome) for one in flight.meetings if one.outcome != PASSED]
    gates = {one.distance_m: one.gate for one in flight.meetings}
    for labels, above, colour in ((ids, 3, OPENING_COLOUR), (failures, 14, "black")):
        for x, text in with_room(labels, inch_m):
            gate = flight.track.gates[gates[x]]
            top_m = gate.position[2] + 0.5 * gate.frame * _upwards(flight.track, gates[x])
            axes.annotate(
                text, (x, top_m), (0, above), textcoords="offset points", color=colour, ha="center",
                weight="bold", fontsize="small",
            )  # fmt: skip


def _draw_fronts(figure: SubFigure, flight: Flight, top: float, shape: tuple[int, int]) -> None:
    """Draw every gate from the front, in flying order."""
    panels = figure.subplots(*shape, squeeze=False).ravel()
    for panel in panels:
        panel.set_axis_off()
    for index, (panel, gate) in enumerate(zip(panels, flight.track.gates, strict=False)):
        _draw_front(panel, gate, [one for one in flight.meetings if one.gate == index], top)
    figure.suptitle(
        "Gates as the drone comes to them, and how many of the meetings passed. Dashed: free for a drone of "
        f"{DRONE_RADIUS_M:g} m radius.\nDots: passed; crosses: frame touched, or missed. Colours: speed.",
        fontsize="small",
    )


def _draw_front(panel: Axes, gate: Gate, meetings: list[Meeting], top: float) -> None:
    """Draw one gate and where the drone met its plane, coloured by speed."""
    free = gate.opening - 2.0 * DRONE_RADIUS_M
    squares = ((gate.frame, "0.85", "-", FRAME_COLOUR), (gate.opening, "white", "-", OPENING_COLOUR))
    for edge, face, line, colour in (*squares, (free, "none", "--", OPENING_COLOUR)):
        corner = (-0.5 * edge, -0.5 * edge)
        panel.add_patch(Rectangle(corner, edge, edge, facecolor=face, edgecolor=colour, linestyle=line))
    for outcome_passed, marker, size in ((True, "o", 36), (False, "X", 110)):
        shown = [one for one in meetings if (one.outcome == PASSED) is outcome_passed]
        right, up = [one.right_m for one in shown], [one.up_m for one in shown]
        speeds = [one.speed_m_s for one in shown]
        panel.scatter(
            right, up, size, speeds, marker=marker, edgecolors="black", linewidths=0.6, vmin=0.0, vmax=top
        )
    for one in [one for one in meetings if one.outcome != PASSED][:MOST_LABELLED]:
        place = (one.right_m, one.up_m)
        panel.annotate(f"lap {one.lap}", place, (7, 2), textcoords="offset points", fontsize="small")
    reach = AROUND * max([0.5 * gate.frame, *(max(abs(one.right_m), abs(one.up_m)) for one in meetings)])
    num_passed = sum(one.outcome == PASSED for one in meetings)
    panel.set(aspect="equal", xlim=(-reach, reach), ylim=(-reach, reach))
    panel.set_title(f"gate {gate.id}: {num_passed} of {len(meetings)}", fontsize="small")
