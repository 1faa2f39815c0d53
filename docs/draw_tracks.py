"""Draw every shipped track and a few random ones: ``python -m docs.draw_tracks``."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from flytrack_env.files import write_atomically
from flytrack_env.pictures import drawing
from flytrack_env.scene import PAPER_OPENING
from flytrack_env.tracks import (
    Track,
    available_tracks,
    build_course,
    load_track,
    random_track,
    sample_way,
)

OUT = Path(__file__).parent / "tracks"
RANDOM_SEEDS = (0, 1)
NUM_SAMPLES = 100
WIDTH_IN, MARGIN_IN = 7.0, 1.2
LOWEST_TOP_M = 3.0  # of the colour scale
START_COLOUR = "tab:blue"


def draw_track(name: str, track: Track) -> Figure:
    """Return a figure of a track from above and, below it, from the side (looking along +y).

    The line is the path on which episodes start in flight, its colour the height. Both views share
    a scale.
    """
    low, size = np.array(track.bounds_low), drawing.extent(track)
    height_in = 0.86 * WIDTH_IN * (size[1] + size[2]) / size[0] + MARGIN_IN
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="compressed")
    top, side = figure.subplots(2, sharex=True, height_ratios=size[1:])
    points = sample_way(build_course(track), NUM_SAMPLES).reshape(-1, 3)
    top_m = drawing.HEADROOM * max(points[:, 2].max(), LOWEST_TOP_M)
    for axes, view in ((top, [0, 1]), (side, [0, 2])):
        axes.add_patch(
            Rectangle(low[view], *size[view], fill=False, edgecolor="0.6", linestyle="--")
        )
        path = drawing.draw_path(axes, points[:, view], points[:-1, 2], top_m)
        drawing.draw_gates(axes, track, view)
        axes.plot(
            *np.array(track.start_position)[view], "o", color=START_COLOUR, markersize=7, zorder=5
        )
        axes.set(aspect="equal", ylabel=f"{'xyz'[view[1]]} (m)")
    drawing.label_from_above(top, track)
    ids: dict[tuple[float, float], list[str]] = {}
    for gate in track.gates:
        height = gate.position[2] + 0.5 * gate.frame + drawing.LABEL_SHARE * size.max()
        ids.setdefault((gate.position[0], height), []).append(str(gate.id))
    for (x, z), names in ids.items():
        side.text(x, z, ", ".join(names), color=PAPER_OPENING, ha="center", weight="bold")
    side.axhline(low[2], color="0.3", linewidth=1.5)
    side.set(xlabel="x (m)")
    top.set(title=f"{name}: gates in red, start in blue")
    figure.colorbar(path, ax=(top, side), label="height of the path (m)", shrink=0.6)
    return figure


def main() -> None:
    """Draw every track of the documentation."""
    tracks = {name: load_track(name) for name in available_tracks()}
    tracks |= {f"random_{seed}": random_track(seed) for seed in RANDOM_SEEDS}
    for name, track in tracks.items():
        write_atomically(OUT / f"{name}.png", drawing.png_of(draw_track(name, track), dpi=110))
        print(OUT / f"{name}.png")


if __name__ == "__main__":
    main()
