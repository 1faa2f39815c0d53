"""Shared parts of the figures: PNGs, a course with its gates, a coloured path, labels."""

import io

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from flytrack_env.scene import PAPER_FRAME, PAPER_OPENING, gates_of
from flytrack_env.tracks import Track, build_course

DPI = 100
LETTER_IN = 0.068  # width of a letter of a small text
LABEL_SHARE, ARROW_SHARE = 0.026, 0.055  # of the larger extent
MIN_ARROW = 0.3  # of a unit vector: a direction seen more head-on than that has no arrow
HEADROOM = 1.2  # of a colour scale, whose last colours are too pale for a line


def escape(text: str) -> str:
    """Escape a text for matplotlib: no mathematics between dollars, no hidden label."""
    text = text.replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure of that size; it belongs to no window and no global state."""
    return Figure(figsize=(width_in, height_in), layout="constrained")


def plain(axes: Axes) -> Axes:
    """Return axes with a faint grid and without the box."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)
    return axes


def png_of(figure: Figure, dpi: int = DPI) -> bytes:
    """Return a figure as a PNG file, without a note of the software that drew it."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi, metadata={"Software": None})
    return content.getvalue()


def extent(track: Track) -> np.ndarray:
    """Return the size of the bounds, (3,), m."""
    return np.subtract(track.bounds_high, track.bounds_low)


def draw_gates(axes: Axes, track: Track, view: list[int]) -> None:
    """Draw the gates' frames, openings and flight directions along the axis not in ``view``."""
    gates = gates_of(build_course(track))
    arrow = {"arrowstyle": "-|>", "color": PAPER_OPENING, "linewidth": 1.5, "shrinkA": 0}
    for centre, forward, outer, inner in zip(*gates, strict=True):
        for corners, colour in ((outer, PAPER_FRAME), (inner, PAPER_OPENING)):
            closed = np.concatenate([corners, corners[:1]])[:, view]
            axes.plot(*closed.T, color=colour, linewidth=2.2, solid_capstyle="butt", zorder=3)
        if np.linalg.norm(forward[view]) > MIN_ARROW:
            tip = centre[view] + ARROW_SHARE * extent(track).max() * forward[view]
            axes.annotate("", xy=tip, xytext=tuple(centre[view]), arrowprops=arrow, zorder=4)


def label_from_above(axes: Axes, track: Track) -> None:
    """Write every gate's id to the left of it."""
    left = np.stack(build_course(track).gates.left(), -1)
    for gate, to_left in zip(track.gates, left, strict=True):
        distance_m = 0.5 * gate.frame + LABEL_SHARE * extent(track).max()
        x, y = (gate.position + distance_m * to_left)[:2]
        axes.text(x, y, str(gate.id), color=PAPER_OPENING, ha="center", va="center", weight="bold")


def draw_path(
    axes: Axes, points: np.ndarray, values: np.ndarray, top: float, linewidth: float = 2.0
) -> LineCollection:
    """Draw a path whose segments have the colours of their values; return it, for a colour bar.

    Args:
        points: (n, 2).
        values: (n - 1,), of the segments.
        top: of the colour scale, which begins at 0.
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
