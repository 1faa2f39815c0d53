"""The position density chart: where evaluation flights spend their time."""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from flytrack_env.files import write_atomically
from flytrack_env.pictures.drawing import draw_gates, label_from_above, png_of
from flytrack_env.tracks import Track

BIN_M = 0.1
MARGIN_M = 3.0
SAMPLE_MS = 10.0
LIMITS_MS = (0.1, 100.0)  # a few of many flights, to all of them on one line, lap after lap
AXES, SCALE = (0.08, 0.06, 0.76, 0.89), (0.86, 0.15, 0.03, 0.7)  # left, bottom, width, height of the figure


def count_positions(positions: np.ndarray, track: Track) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how many positions lie in each bin of 0.1 m x 0.1 m, (num_x, num_y), and the edges, m.

    positions: (num_samples, 3), world, m. The bins cover gates and start and some way around them.
    """
    corners = np.array([gate.position[:2] for gate in track.gates] + [track.start_position[:2]])
    low, high = corners.min(axis=0) - MARGIN_M, corners.max(axis=0) + MARGIN_M
    edges = [np.arange(a, b + BIN_M, BIN_M) for a, b in zip(low, high, strict=True)]
    return np.histogram2d(positions[:, 0], positions[:, 1], bins=edges)


def draw_position_density(
    path: str | Path, positions: np.ndarray, track: Track, num_flights: int, label: str = ""
) -> None:
    """Write a PNG heat map of x-y positions, (num_samples, 3) m at 100 Hz, in bins of 0.1 m x 0.1 m.

    The colour is the time that a flight spends in a bin, ms, on a logarithmic scale that is the same for all
    charts, so that those of one run can be compared. label: what stands beside the track's name.
    """
    counts, *edges = count_positions(positions, track)
    figure = Figure(figsize=(8, 9))  # placed by hand: a layout engine draws everything twice
    axes, scale = figure.add_axes(AXES), figure.add_axes(SCALE)
    axes.set_facecolor(matplotlib.colormaps["viridis"](0.0))
    image = axes.imshow(
        np.ma.masked_equal(counts.T, 0) * SAMPLE_MS / num_flights,
        extent=(edges[0][0], edges[0][-1], edges[1][0], edges[1][-1]),
        origin="lower",
        interpolation="none",
        cmap="viridis",
        norm=LogNorm(*LIMITS_MS),
    )
    # Plain numbers: what parses the powers of ten keeps, in its exceptions, all that the callers hold.
    figure.colorbar(image, cax=scale, label="time per flight in 0.1 m x 0.1 m (ms)", format="%g")
    draw_gates(axes, track, [0, 1])
    label_from_above(axes, track)
    axes.plot(*track.start_position[:2], "o", color="white", markersize=5)
    axes.text(track.start_position[0], track.start_position[1] - 0.8, "start", color="white")
    outside = 1.0 - counts.sum() / max(len(positions), 1)
    parts = (track.name, label, f"{outside:.1%} of the time outside the chart" if outside > 0.0 else "")
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.set_title("Position density: " + ", ".join(filter(None, parts)))
    write_atomically(path, png_of(figure, dpi=100))
