"""The figures of ``report.md`` that the exercise asks for: ``python -m benchmarks.exercise``.

Trains the default recipe from scratch on FlyTrack-v0 and draws its training curves, and where its
evaluation flights are at several stages of the training. Writes two PNGs to ``docs/pictures``.
"""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from baselines.purejaxrl_ppo import Config, load_checkpoint
from baselines.purejaxrl_ppo.checkpoint import checkpoints_in
from baselines.purejaxrl_ppo.checkpoint_env import simulated_env
from baselines.purejaxrl_ppo.flights import fly_many, score
from baselines.purejaxrl_ppo.metrics import summarize_updates
from baselines.purejaxrl_ppo.monitor import (
    EVALUATION_SEED,
    NUM_LAPS,
    NUM_STEPS,
    draw_density,
)
from baselines.purejaxrl_ppo.training import Options, train_policy
from benchmarks import report
from flytrack_env.files import write_atomically
from flytrack_env.pictures.drawing import new_figure, plain, png_of

STAGES = (0.5e6, 2e6, 5e6, 20e6)  # environment steps of a chart
STORE_EVERY = 500_000
NUM_EPISODES = 64  # of a chart
BINS = 60  # means of updates that make a point of a curve
# Metric -> label, the ones that the exercise names.
CURVES = {
    "episode_return": "mean episode return",
    "episode_length": "mean episode length (steps)",
    "episode_gates_passed": "gates passed in an episode",
    "gate_distance_m": "mean distance to the gate (m)",
    "episode_out_of_bounds": "share ended out of bounds",
    "episode_truncated": "share ended by the time limit",
    "policy_loss": "policy loss",
    "value_loss": "value loss",
    "entropy": "entropy",
}
PICTURES = report.ROOT / "docs" / "pictures"
DPI = 110


def draw_curves(metrics: dict[str, np.ndarray], config: Config) -> Figure:
    """Return the training curves as small multiples over environment steps."""
    parts = np.array_split(np.arange(config.num_updates), BINS)
    rows = [summarize_updates({name: v[part] for name, v in metrics.items()}) for part in parts]
    steps_m = [(part[-1] + 1) * config.batch_size / 1e6 for part in parts]
    figure = new_figure(9.0, 6.6)
    all_axes = figure.subplots(3, 3, sharex=True)
    for axes, (name, label) in zip(all_axes.flat, CURVES.items(), strict=True):
        plain(axes).plot(steps_m, [row.get(name, np.nan) for row in rows], linewidth=1.6)
        axes.set_title(label, fontsize=9, loc="left")
        axes.tick_params(labelsize=8)
    figure.supxlabel("environment steps (millions)", fontsize=9)
    return figure


def draw_stages(checkpoints: dict[int, Path]) -> Figure:
    """Return position densities of evaluation flights after numbers of environment steps."""
    figure = new_figure(11.0, 4.4)
    image: Any = None
    all_axes = figure.subplots(1, len(checkpoints), sharex=True, sharey=True)
    for axes, (steps, path) in zip(all_axes, checkpoints.items(), strict=True):
        checkpoint = load_checkpoint(path)
        env = simulated_env(checkpoint)
        flown = fly_many(env, checkpoint.policy, EVALUATION_SEED, NUM_EPISODES, NUM_STEPS, NUM_LAPS)
        image = draw_density(axes, flown.positions(), env.track, NUM_EPISODES)
        gates = score(flown.outcome).gates
        axes.set_title(f"{steps / 1e6:.1f} M steps: {gates:.1f} gates", fontsize=9, pad=12)
        axes.set(xlabel="x (m)", aspect="equal")
        print(f"{steps} steps: {gates:.2f} gates a flight", flush=True)
    all_axes[0].set_ylabel("y (m)")
    label = "time per flight in 0.1 m x 0.1 m (ms)"
    figure.colorbar(image, ax=all_axes, label=label, format="%g", shrink=0.8)
    return figure


def main(seed: int = 0) -> None:
    """Train, draw, and write both pictures.

    Args:
        seed: of the training.
    """
    config = Config()
    with tempfile.TemporaryDirectory() as folder:
        options = Options(checkpoint_every=STORE_EVERY)
        _, metrics = train_policy(Path(folder), config, seed, options=options)
        stored = {
            load_checkpoint(path).meta["steps"]: path for path in checkpoints_in(Path(folder))
        }
        stages = [min(stored, key=lambda steps: abs(steps - stage)) for stage in STAGES]
        density = draw_stages({steps: stored[steps] for steps in stages})
    curves = draw_curves(metrics, config)
    for name, figure in (("training_curves", curves), ("training_density", density)):
        write_atomically(PICTURES / f"{name}.png", png_of(figure, dpi=DPI))
        print(f"written: {PICTURES / name}.png")
    print(report.provenance_line(report.provenance()))


if __name__ == "__main__":
    report.command(main)
