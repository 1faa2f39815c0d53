"""Draw every shipped track and a few random ones: ``python -m docs.draw_tracks``."""

import argparse
import hashlib
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from flytrack_env.files import write_atomically
from flytrack_env.pictures.drawing import (
    HEADROOM,
    LABEL_SHARE,
    draw_gates,
    draw_path,
    extent,
    label_from_above,
    png_of,
)
from flytrack_env.scene import PAPER_OPENING
from flytrack_env.tracks import Track, available_tracks, build_course, load_track, random_track, sample_way

RANDOM_SEEDS = (0, 1)
NUM_SAMPLES = 100
DPI = 110
PANEL_IN = (6.8, 6.5)  # the largest width and height of the view from above
LEFT_IN, RIGHT_IN, BOTTOM_IN, TOP_IN, GAP_IN, BAR_IN = 0.75, 1.0, 0.6, 0.45, 0.35, 0.18
MARGIN_SHARE = 0.03  # of the larger extent
TOP_VIEW, SIDE_VIEW = [0, 1], [0, 2]
START_COLOUR = "tab:blue"
LOWEST_TOP_M = 3.0  # of the colour scale


def digest(track: Track) -> str:
    """Return what tells a picture of this track from one of another."""
    return hashlib.sha256(repr(track).encode()).hexdigest()


def label_from_the_side(axes: Axes, track: Track) -> None:
    """Write the gates' ids above them; gates in one column share a label, the highest first."""
    room = LABEL_SHARE * extent(track).max()
    columns: list[list] = []
    for gate in sorted(track.gates, key=lambda gate: gate.position[0]):
        if columns and gate.position[0] - columns[-1][-1].position[0] < 1.5 * room:
            columns[-1].append(gate)
        else:
            columns.append([gate])
    for column in columns:
        ordered = sorted(column, key=lambda gate: -gate.position[2])
        x = np.mean([gate.position[0] for gate in column])
        z = max(gate.position[2] + 0.5 * gate.frame for gate in column) + room
        text = ", ".join(str(gate.id) for gate in ordered)
        axes.text(x, z, text, color=PAPER_OPENING, ha="center", va="center", weight="bold")


def draw_view(axes: Axes, track: Track, view: list[int]) -> LineCollection:
    """Draw bounds, way, gates and start, seen along the axis not in ``view``; return the coloured way."""
    low, size = np.array(track.bounds_low)[view], extent(track)[view]
    label = LABEL_SHARE * extent(track).max()
    style = {"fill": False, "edgecolor": "0.6", "linestyle": "--"}
    axes.add_patch(Rectangle(low, *size, **style))
    points = sample_way(build_course(track), NUM_SAMPLES).reshape(-1, 3)
    top_m = HEADROOM * max(points[:, 2].max(), LOWEST_TOP_M)
    lines = draw_path(axes, points[:, view], points[:-1, 2], top_m)
    draw_gates(axes, track, view)
    start = np.array(track.start_position)[view]
    axes.plot(*start, "o", color=START_COLOUR, markersize=7, zorder=5)
    # Where the way is farthest; from the side, below the ground.
    corners = [(1.5, -0.9), (-1.5, -0.9), (1.5, 0.9), (-1.5, 0.9)][: 2 if view == SIDE_VIEW else 4]
    places = [start + label * np.array(corner) for corner in corners]
    place = max(places, key=lambda place: np.linalg.norm(points[:, view] - place, axis=1).min())
    axes.text(*place, "start", color=START_COLOUR, ha="center", va="center")
    return lines


def draw_track(path: str | Path, track: Track) -> None:
    """Write a PNG of a track: from above and, below it, from the side (looking along +y).

    The line is the way on which episodes start in flight, its colour the height. Both views have one scale.
    """
    low, margin = np.array(track.bounds_low), MARGIN_SHARE * extent(track).max() * np.ones(3)
    margin[2] *= 2.0  # room for a word below the ground
    size = extent(track) + 2.0 * margin
    scale = min(PANEL_IN[0] / size[0], PANEL_IN[1] / size[1])
    width, depth, height = scale * size
    total = np.array([LEFT_IN + width + RIGHT_IN, BOTTOM_IN + height + GAP_IN + depth + TOP_IN])
    figure = Figure(figsize=total)

    def place(left: float, bottom: float, wide: float, high: float) -> Axes:
        return figure.add_axes((left / total[0], bottom / total[1], wide / total[0], high / total[1]))

    side = place(LEFT_IN, BOTTOM_IN, width, height)
    top = place(LEFT_IN, BOTTOM_IN + height + GAP_IN, width, depth)
    lines = draw_view(top, track, TOP_VIEW)
    draw_view(side, track, SIDE_VIEW)
    label_from_above(top, track)
    label_from_the_side(side, track)
    side.axhline(track.bounds_low[2], color="0.3", linewidth=1.5)
    ends = np.stack([low - margin, low - margin + size], axis=-1)
    top.set(xlim=ends[0], ylim=ends[1], ylabel="y (m)", title=Path(path).stem)
    side.set(xlim=ends[0], ylim=ends[2], ylabel="z (m)", xlabel="x (m)")
    side.set_yticks([tick for tick in side.get_yticks() if low[2] <= tick <= ends[2, 1]])
    top.tick_params(labelbottom=False)
    bar = place(LEFT_IN + width + BAR_IN, BOTTOM_IN + height + GAP_IN, BAR_IN, depth)
    figure.colorbar(lines, cax=bar, label="height of the way (m)")
    write_atomically(path, png_of(figure, DPI, {"Track": digest(track)}))


def drawn_tracks() -> dict[str, Track]:
    """Return the tracks that have a picture, by the name of its file."""
    shipped = {name: load_track(name) for name in available_tracks()}
    return {**shipped, **{f"random_{seed}": random_track(seed) for seed in RANDOM_SEEDS}}


def main() -> None:
    """Draw every track of the documentation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/tracks"))
    arguments = parser.parse_args()
    for name, track in drawn_tracks().items():
        draw_track(arguments.out / f"{name}.png", track)
        print(arguments.out / f"{name}.png")


if __name__ == "__main__":
    main()
