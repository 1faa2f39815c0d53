"""Evaluation flights during training: their metrics, files, and where they spend their time."""

import logging
from pathlib import Path
from typing import Any

import jax
import matplotlib
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from baselines.purejaxrl_ppo.flights import (
    CANNOT_RECORD,
    Outcomes,
    can_record,
    fly_many,
    record_flights,
    save_flight,
    score,
)
from baselines.purejaxrl_ppo.networks import Policy
from flytrack_env.files import write_atomically
from flytrack_env.messages import error_text
from flytrack_env.pictures.drawing import draw_gates, label_from_above, png_of
from flytrack_env.tracks import Track

NUM_LAPS = 3
NUM_STEPS = 2500  # 25 s at 100 Hz: three laps of the slowest shipped track, flown by a beginner
# of the noisy starts: the same at every evaluation, unlike usual training seeds
EVALUATION_SEED = 20_000
BIN_M = 0.1
MARGIN_M = 3.0
SAMPLE_MS = 10.0
LIMITS_MS = (0.1, 100.0)  # a few of many flights, to all of them on one line, lap after lap
AXES, SCALE = (
    (0.08, 0.06, 0.76, 0.89),
    (0.86, 0.15, 0.03, 0.7),
)  # left, bottom, width, height of the figure

logger = logging.getLogger(__name__)


def evaluation_metrics(outcomes: Outcomes) -> dict[str, float]:
    """Return the metrics of evaluation flights (docs/baseline.md); missing times are left out."""
    values = {
        **score(outcomes)._asdict(),
        "laps": outcomes.laps.mean(),
        "best_lap_s": outcomes.flying_laps_s().min(initial=np.inf),
        "steps": outcomes.steps.mean(),
        **{f"ended_{name}": happened.mean() for name, happened in outcomes.ends().items()},
    }
    return {
        f"evaluation_{name}": float(value) for name, value in values.items() if np.isfinite(value)
    }


def evaluate_policy(
    env: Any, policy: Policy, num_episodes: int, folder: Path, steps: int, is_recorded: bool = False
) -> tuple[dict[str, float], list[Path]]:
    """Fly noisy starts; write the first flight and the position density of all.

    What fails is a warning, and the rest is returned: an evaluation must not end the training.

    Args:
        env: that the policy flies in.
        policy: whose mean action flies.
        num_episodes: number of flights.
        folder: of the files.
        steps: environment steps of training so far, part of the files' names.
        is_recorded: also write the first flight as a Rerun recording, if Rerun is installed.

    Returns:
        Metrics by name, and the files.
    """
    metrics: dict[str, float] = {}
    files: list[Path] = []
    rollout, chart = folder / f"rollout_{steps}.npy", folder / f"position_density_{steps}.png"
    try:
        flights = fly_many(env, policy, EVALUATION_SEED, num_episodes, NUM_STEPS, NUM_LAPS)
        metrics = evaluation_metrics(flights.outcome)
        first = jax.tree.map(lambda leaf: leaf[0], flights)
        save_flight(rollout, first)
        files.append(rollout)
        label = f"{steps:,} training steps"
        draw_position_density(chart, flights.positions(), env.track, num_episodes, label)
        files.append(chart)
        if is_recorded and can_record():
            recording = rollout.with_suffix(".rrd")
            record_flights(recording, {"policy": first}, env.track)
            files.append(recording)
        elif is_recorded:
            logger.warning(
                "evaluation after %d steps: no recording (.rrd): %s", steps, CANNOT_RECORD
            )
    except Exception as error:  # whatever libraries that draw and record raise
        message = "evaluation after %d steps failed: %s: %s; training goes on"
        logger.warning(message, steps, type(error).__name__, error_text(error))
    return metrics, files


def draw_position_density(
    path: str | Path, positions: np.ndarray, track: Track, num_flights: int, label: str = ""
) -> None:
    """Write a PNG heat map of x-y positions in bins of 0.1 m x 0.1 m.

    The colour is the time that a flight spends in a bin, ms, on a logarithmic scale that is the
    same for all charts, so that those of one run can be compared. The bins cover gates and start
    and some way around them.

    Args:
        path: of the file.
        positions: at 100 Hz, world, (num_samples, 3), m.
        track: that is drawn.
        num_flights: that the positions are from.
        label: what stands beside the track's name.
    """
    figure = Figure(figsize=(8, 9))  # placed by hand: a layout engine draws everything twice
    axes, scale = figure.add_axes(AXES), figure.add_axes(SCALE)
    image = draw_density(axes, positions, track, num_flights)
    # Plain numbers: what parses the powers of ten keeps, in its exceptions, all that the callers
    # hold.
    figure.colorbar(image, cax=scale, label="time per flight in 0.1 m x 0.1 m (ms)", format="%g")
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.set_title("Position density: " + ", ".join(filter(None, (track.name, label))))
    write_atomically(path, png_of(figure, dpi=100))


def draw_density(axes: Any, positions: np.ndarray, track: Track, num_flights: int) -> Any:
    """Draw the heat map of ``draw_position_density`` and return it, for a colour bar."""
    corners = np.array([gate.position[:2] for gate in track.gates] + [track.start_position[:2]])
    low, high = corners.min(axis=0) - MARGIN_M, corners.max(axis=0) + MARGIN_M
    edges = [np.arange(a, b + BIN_M, BIN_M) for a, b in zip(low, high, strict=True)]
    axes.set_facecolor(matplotlib.colormaps["viridis"](0.0))
    *_, image = axes.hist2d(
        positions[:, 0],
        positions[:, 1],
        bins=edges,
        weights=np.full(len(positions), SAMPLE_MS / num_flights),
        cmin=LIMITS_MS[0] * 1e-3,
        norm=LogNorm(*LIMITS_MS),
    )
    draw_gates(axes, track, [0, 1])
    label_from_above(axes, track)
    axes.plot(*track.start_position[:2], "o", color="white", markersize=5)
    axes.text(track.start_position[0], track.start_position[1] - 0.8, "start", color="white")
    return image
