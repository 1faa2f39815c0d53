"""What pictures of a course share: its gates, their numbers, a path in colours."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize

from flytrack_env.tracks import Track, build_course

LABEL_SHARE, ARROW_SHARE = 0.026, 0.055  # of the larger extent
SHORTEST_ARROW = 0.3  # of a unit vector: a direction seen more head-on than that has no arrow
HEADROOM = 1.2  # of a colour scale, whose last colours are too pale for a line
FRAME_COLOUR, OPENING_COLOUR = "0.25", "tab:red"


def extent(track: Track) -> np.ndarray:
    """Return the size of the bounds, (3,), m."""
    return np.subtract(track.bounds_high, track.bounds_low)


def draw_gates(axes: Axes, track: Track, view: list[int]) -> None:
    """Draw every gate's frame, opening and direction of flight, seen along the axis not in ``view``."""
    gates = build_course(track).gates
    frames = zip(*(np.stack(axis, -1) for axis in (gates.forward, gates.left(), gates.up)), strict=True)
    for gate, (forward, left, up) in zip(track.gates, frames, strict=True):
        centre = np.array(gate.position)
        for edge, colour in ((gate.frame, FRAME_COLOUR), (gate.opening, OPENING_COLOUR)):
            signs = ((1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1))
            corners = np.array([centre + 0.5 * edge * (a * left + b * up) for a, b in signs])
            axes.plot(*corners[:, view].T, color=colour, linewidth=2.2, solid_capstyle="butt", zorder=3)
        seen = forward[view]
        if np.linalg.norm(seen) > SHORTEST_ARROW:
            tip = centre[view] + ARROW_SHARE * extent(track).max() * seen
            arrow = {"arrowstyle": "-|>", "color": OPENING_COLOUR, "linewidth": 1.5, "shrinkA": 0}
            axes.annotate("", xy=tip, xytext=tuple(centre[view]), arrowprops=arrow, zorder=4)


def label_places(track: Track) -> np.ndarray:
    """Return where, seen from above, the gates' ids are written: to the left of them, (num_gates, 2), m."""
    left = np.stack(build_course(track).gates.left(), -1)
    centres = np.array([gate.position for gate in track.gates])
    frames = np.array([gate.frame for gate in track.gates])
    distances = 0.5 * frames + LABEL_SHARE * extent(track).max()
    return (centres + distances[:, None] * left)[:, :2]


def taken_from_above(track: Track) -> np.ndarray:
    """Return points of the gates, their arrows and their ids, from above, (n, 2), m: no place for a text."""
    gates = build_course(track).gates
    centres, left, forward = (
        np.stack(axis, -1)[:, :2] for axis in (gates.centre, gates.left(), gates.forward)
    )
    sides = [share * np.asarray(gates.half_frame)[:, None] * left for share in np.linspace(-1.0, 1.0, 5)]
    tips = [share * extent(track).max() * forward for share in (0.5 * ARROW_SHARE, ARROW_SHARE)]
    return np.concatenate([*(centres + offset for offset in (*sides, *tips)), label_places(track)])


def label_from_above(axes: Axes, track: Track) -> None:
    """Write every gate's id beside it."""
    for gate, place in zip(track.gates, label_places(track), strict=True):
        axes.text(
            place[0], place[1], str(gate.id), color=OPENING_COLOUR, ha="center", va="center", weight="bold"
        )


def draw_path(
    axes: Axes, points: np.ndarray, values: np.ndarray, top: float, linewidth: float = 2.0
) -> LineCollection:
    """Draw a path whose segments have the colours of their values; return it, for a colour bar.

    points: (n, 2). values: (n - 1,), of the segments. top: of the colour scale, which begins at 0.
    """
    lines = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)),
        array=values,
        norm=Normalize(0.0, top),
        linewidth=linewidth,
        capstyle="round",
    )
    axes.add_collection(lines)
    return lines
