"""A policy of convolutions and a memory learns from masks; no champion, but it learns.

``python -m benchmarks.mask_learning [--steps 2000000] [--seed 0] [--runs FOLDER] [--out PAGE]``
trains PPO on ``FlyTrackMask-v0`` and prints returns and gates over the training.
"""

from pathlib import Path
from typing import Any

import numpy as np

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.training import train_policy
from benchmarks import report

ENV_ID = "FlyTrackMask-v0"
# Fewer environments than for numbers, as an update holds 4 kB of image a step.
SETTINGS: dict[str, Any] = {
    "memory_size": 64,
    "num_envs": 256,
    "num_steps": 32,
    "num_minibatches": 16,
    "learning_rate": 1e-3,
    "gate_margin": 0.0,
}
ROWS = 8  # of the table


def main(
    steps: int = 2_000_000,
    seed: int = 0,
    runs: Path = Path("runs/mask_learning"),
    out: Path | None = None,
) -> None:
    """Train, print and write.

    Args:
        steps: of the environments.
        seed: of the training.
        runs: folder of its checkpoint.
        out: page.
    """
    config = Config(total_timesteps=steps, **SETTINGS)
    final, metrics = train_policy(runs, config, seed, ENV_ID)
    parts = {
        name: np.array_split(metrics[name], ROWS)
        for name in ("last_return", "episode_gates_passed", "episode_length")
    }
    ends = np.cumsum([len(part) for part in parts["last_return"]]) * config.batch_size
    rows = [
        [f"{end:,}", *(f"{np.nanmean(part[index]):.2f}" for part in parts.values())]
        for index, end in enumerate(ends)
    ]
    report.fill_page(
        out,
        "mask_learning",
        curve=report.table("steps, until | return | gates passed | steps of an episode", rows),
        settings=report.list_settings(SETTINGS),
        seed=seed,
        seconds=f"{final.meta['seconds']:.0f}",
    )


if __name__ == "__main__":
    report.command(main)
