"""The course from above with the path that was flown."""

import itertools
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from flytrack_env.pictures.course_view import (
    HEADROOM,
    draw_gates,
    draw_path,
    label_from_above,
    taken_from_above,
)
from flytrack_env.pictures.flight import PASSED, Flight
from flytrack_env.pictures.style import BLUE, COLOURS, LETTER_IN, LINES, ORANGE, literal, new_figure
from flytrack_env.state import POSITION
from flytrack_env.tracks import Track

PANEL_IN, BESIDE_IN, TITLE_IN = 7.0, 1.6, 1.0  # the view's longer side; room beside and above it
NARROWEST = 0.35  # of the longer side
MARGIN_SHARE = 0.03
BOLD_LETTER_IN, LINE_IN = 0.085, 0.17  # per letter of a bold text; a text's height
VIEW = [0, 1]


def draw_top(flight: Flight) -> Figure:
    """Return the course from above, the path coloured by speed, lap times in the title."""
    figure, axes, inch_m = _course([flight], BESIDE_IN)
    points, speeds = flight.states[:, POSITION][:, :2], flight.speeds_m_s
    lines = draw_path(axes, points, speeds[:-1], HEADROOM * max(float(speeds.max()), 1.0), 2.2)
    failures = [one.pos_w[:2] for one in flight.meetings if one.outcome != PASSED]
    axes.plot(
        *np.reshape(failures, (-1, 2)).T, "X", color="black", markersize=8, markeredgecolor="white", zorder=5
    )
    marks = [("start", points[0], BLUE, "o"), (flight.ended, points[-1], ORANGE, "X")]
    avoid = np.concatenate([points, taken_from_above(flight.track)])
    for text, place, colour, marker in marks:
        axes.plot(*place, marker, color=colour, markersize=9, markeredgecolor="white", zorder=6)
        middle = _free_place(place, text, avoid, axes, inch_m)
        axes.text(middle[0], middle[1], text, color=colour, ha="center", va="center", weight="bold", zorder=7)
        avoid = np.concatenate([avoid, middle[None]])
    axes.set_title(literal(f"{flight.title}\n{flight.laps_in_words}"), fontsize="medium")
    figure.colorbar(lines, ax=axes, label="speed (m/s)", shrink=0.8)
    return figure


def draw_comparison(flights: Sequence[Flight]) -> Figure:
    """Return the course from above with a path per flight, all on one track, in a colour of its own."""
    texts = [literal(f"{flight.name}\n{flight.laps_in_words}\n{flight.ended}") for flight in flights]
    longest = max(len(line) for text in texts for line in text.splitlines())
    figure, axes, _ = _course(flights, BESIDE_IN + LETTER_IN * longest)
    styles = itertools.cycle(itertools.product(LINES, COLOURS))
    for flight, text, (line, colour) in zip(flights, texts, styles, strict=False):
        points = flight.states[:, POSITION][:, :2]
        axes.plot(*points.T, line, color=colour, linewidth=1.5, label=text)
        axes.plot(*points[0], "o", color=colour, markeredgecolor="white", zorder=6)
        axes.plot(*points[-1], "X", color=colour, markersize=9, markeredgecolor="white", zorder=6)
    axes.set_title(literal(f"{len(flights)} flights on {flights[0].track.name}"), fontsize="medium")
    figure.legend(loc="outside right upper", frameon=False, fontsize="small", labelspacing=1.0)
    return figure


def _course(flights: Sequence[Flight], beside_in: float) -> tuple[Figure, Axes, float]:
    """Return a figure with bounds and gates, wide enough for the flights, and how many m an inch is."""
    track = flights[0].track
    low, high = _limits(flights, track)
    size = (high - low) / (high - low).max()
    width, height = PANEL_IN * np.maximum(size, NARROWEST)
    figure = new_figure(width + beside_in, height + TITLE_IN)
    axes = figure.add_subplot()
    ends = np.array([track.bounds_low, track.bounds_high])[:, :2]
    axes.add_patch(Rectangle(ends[0], *(ends[1] - ends[0]), fill=False, edgecolor="0.6", linestyle="--"))
    draw_gates(axes, track, VIEW)
    label_from_above(axes, track)
    axes.set(aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x (m)", ylabel="y (m)")
    return figure, axes, float((high - low).max() / PANEL_IN)


def _limits(flights: Sequence[Flight], track: Track) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (2,), m, of what is shown: the bounds, and where a flight left them."""
    points = [flight.states[:, POSITION] for flight in flights]
    seen = np.concatenate([*points, [track.bounds_low, track.bounds_high]])[:, :2]
    low, high = seen.min(axis=0), seen.max(axis=0)
    margin = MARGIN_SHARE * (high - low).max()
    return low - margin, high + margin


def _free_place(at: np.ndarray, text: str, avoid: np.ndarray, axes: Axes, inch_m: float) -> np.ndarray:
    """Return the middle (2,) of a text beside a point: of eight places the one with the most room."""
    half = 0.5 * inch_m * np.array([BOLD_LETTER_IN * len(text), LINE_IN])
    limits = np.array([axes.get_xlim(), axes.get_ylim()])

    def room(middle: np.ndarray) -> float:
        beyond = np.abs(avoid - middle) - half
        inside = np.concatenate([middle - half - limits[:, 0], limits[:, 1] - middle - half])
        return min(float(beyond.max(axis=1).min()), float(inside.min()))

    ways = [way for way in itertools.product((-1, 0, 1), repeat=2) if any(way)]
    return max((at + way * (half + 0.8 * LINE_IN * inch_m) for way in np.array(ways)), key=room)
