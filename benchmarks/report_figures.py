"""Training curves, and position density at four stages: ``python -m benchmarks.report_figures``.

Trains the default recipe on the model of the ablations, several seeds; flies 256 noisy starts at each stage
of the first one. Writes ``docs/results/training_curves.png`` and ``position_density_STAGE.png`` beside it.
"""

import argparse
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.density import draw_position_density
from baselines.purejaxrl_ppo.flights import fly_many
from baselines.purejaxrl_ppo.training import Trainer
from benchmarks.report import RESULTS, ROOT, pin_to_one_core, progress
from flytrack_env.files import write_atomically
from flytrack_env.pictures.drawing import png_of

MODEL = ROOT / "benchmarks" / "data" / "ablations" / "model.json"
STAGES_STEPS = (1_000_000, 2_000_000, 4_000_000, 20_000_000)
NUM_EPISODES, NUM_LAPS, NUM_STEPS = 256, 3, 2500
EVALUATION_SEED = 30_000
# Panels: a metric of an update and its label.
CURVES = {
    "episode_return": "return of an episode",
    "episode_length": "length of an episode (steps)",
    "episode_gates_passed": "gates passed in an episode",
    "policy_loss": "policy loss",
    "value_loss": "value loss",
    "entropy": "entropy",
    "explained_variance": "explained variance",
    "gate_distance_m": "distance to the gate (m)",
}


def train(trainer: Trainer, seed: int, folder: Path | None) -> dict[str, np.ndarray]:
    """Return every metric of every update; folder: of the density charts, None for none."""
    config, rows = trainer.config, []
    stages = {round(steps / config.batch_size): steps for steps in STAGES_STEPS}
    runner = trainer.start(jax.random.key(seed))
    for update in progress(range(1, config.num_updates + 1), f"updates of seed {seed}"):
        runner, metrics = trainer.chunk(runner, jnp.int32(1))
        rows.append({name: float(values[0]) for name, values in metrics.items()})
        if folder is not None and update in stages:
            draw_stage(trainer, runner.train_state.params, stages[update], folder)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def draw_stage(trainer: Trainer, policy: Any, steps: int, folder: Path) -> None:
    """Write the position density of a stage's flights."""
    flights = fly_many(
        trainer.env, trainer.network, policy, EVALUATION_SEED, NUM_EPISODES, NUM_STEPS, NUM_LAPS
    )
    label = f"after {steps / 1e6:g} M steps"
    path = folder / f"position_density_{steps / 1e6:g}M.png"
    draw_position_density(path, flights.positions(), trainer.env.track, NUM_EPISODES, label)


def draw_curves(curves: list[dict[str, np.ndarray]], batch_size: int) -> bytes:
    """Return a PNG with a panel per metric and a line per seed."""
    figure = Figure(figsize=(12, 5.5), layout="constrained")
    for panel, (name, label) in zip(figure.subplots(2, 4, sharex=True).flat, CURVES.items(), strict=True):
        for seed, metrics in enumerate(curves):
            steps = batch_size * np.arange(1, len(metrics[name]) + 1) / 1e6
            panel.plot(steps, metrics[name], linewidth=1.0, label=f"seed {seed}")
        panel.set_title(label, fontsize=10)
        panel.grid(alpha=0.3)
    figure.axes[0].legend(fontsize=8)
    figure.supxlabel("environment steps (millions)")
    return png_of(figure, 110)


def main() -> None:
    """Train, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3, help="number of trainings")
    parser.add_argument("--total-timesteps", type=float, default=Config.total_timesteps, help="per training")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the pictures")
    arguments = parser.parse_args()
    pin_to_one_core()
    trainer = Trainer(Config(total_timesteps=int(arguments.total_timesteps)), model=MODEL)
    curves = [train(trainer, seed, arguments.out if seed == 0 else None) for seed in range(arguments.seeds)]
    write_atomically(arguments.out / "training_curves.png", draw_curves(curves, trainer.config.batch_size))


if __name__ == "__main__":
    main()
