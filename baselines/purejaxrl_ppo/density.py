"""The position density chart: where evaluation flights spend their time."""

import io
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from flytrack_env.files import write_atomically
from flytrack_env.tracks import Track, build_course

BIN_M = 0.1
MARGIN_M = 3.0
ARROW_M = 1.5


def draw_gates(axes: Axes, track: Track) -> None:
    """Draw every gate from above: frame, opening, number in flying order, direction of flight."""
    gates = build_course(track).gates
    for index, gate in enumerate(track.gates):
        centre = np.array(gate.position[:2])
        forward = np.array([gates.forward.x[index], gates.forward.y[index]])
        across = np.array([-forward[1], forward[0]])
        for edge, width, colour in ((gate.frame, 2, "0.35"), (gate.opening, 4, "tab:red")):
            ends = np.stack([centre - 0.5 * edge * across, centre + 0.5 * edge * across])
            axes.plot(*ends.T, color=colour, linewidth=width, solid_capstyle="butt")
        axes.annotate(
            "",
            xy=centre + ARROW_M * forward,
            xytext=centre,
            arrowprops={"arrowstyle": "->", "color": "tab:red"},
        )
        label = centre + (0.5 * gate.frame + 0.7) * across
        axes.text(*label, str(index + 1), color="tab:red", ha="center", va="center")


def draw_position_density(path: str | Path, positions: np.ndarray, track: Track) -> None:
    """Write a PNG heat map of x-y positions, (num_samples, 3) m, in bins of 0.1 m x 0.1 m.

    The colour is the number of samples (100 a second) per bin, on a logarithmic scale.
    """
    corners = np.array([gate.position[:2] for gate in track.gates] + [track.start_position[:2]])
    low, high = corners.min(axis=0) - MARGIN_M, corners.max(axis=0) + MARGIN_M
    edges = [np.arange(a, b + BIN_M, BIN_M) for a, b in zip(low, high, strict=True)]
    density, *_ = np.histogram2d(positions[:, 0], positions[:, 1], bins=edges)
    figure = Figure(figsize=(8, 9), layout="constrained")
    axes = figure.subplots()
    axes.set_facecolor(matplotlib.colormaps["viridis"](0.0))
    image = axes.pcolormesh(
        *edges,
        np.ma.masked_equal(density.T, 0),
        cmap="viridis",
        norm=LogNorm(vmin=1, vmax=max(density.max(), 10)),
    )
    figure.colorbar(image, ax=axes, label="samples per 0.1 m x 0.1 m (100 Hz)", shrink=0.8)
    draw_gates(axes, track)
    axes.plot(*track.start_position[:2], "o", color="white", markersize=5)
    axes.text(track.start_position[0], track.start_position[1] - 0.8, "start", color="white")
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title=f"Position density: {track.name}")
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=120)
    write_atomically(path, content.getvalue())
