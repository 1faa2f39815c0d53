"""From black box to race, once per training seed: ``python -m benchmarks.learning``.

Identifies the black box once, then for every seed trains PPO from scratch on the identified model and flies
256 noisy starts over 3 laps on the black box itself, and again with a drone that is thicker than the race's:
how far from the frames does the policy stay on a plant that it never saw? Writes a table of all seeds.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import jax

from baselines.purejaxrl_ppo import Checkpoint, Config
from baselines.purejaxrl_ppo.evaluate import SHIPPED_BLACK_BOX
from baselines.purejaxrl_ppo.flights import race_many, score, start_keys
from baselines.purejaxrl_ppo.race_env import plant_env
from baselines.purejaxrl_ppo.training import train_policy
from benchmarks import report
from demo import NUM_EPISODES, NUM_LAPS, NUM_STEPS, identify
from flytrack_env import blackbox
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.files import fresh_folder

TARGET_SUCCESS = 0.95
THICKER_M = (0.05, 0.10, 0.15, 0.20, 0.25)
HEADER = (
    "seed | success on the black box | margin (m) | gates of 24 | first lap (s) | flying lap (s) | "
    "training CPU (s) | training wall (s)"
)


def margin_of(env: EpisodicEnvironment, checkpoint: Checkpoint, keys: jax.Array) -> float:
    """Return by how much the drone may be thicker, to every side, so that the target is still met, m."""
    margin, params = 0.0, env.default_params
    for thicker in THICKER_M:
        thick = params.replace(drone_radius=params.drone_radius + thicker)
        flown = race_many(env, checkpoint.network, checkpoint.params, keys, NUM_STEPS, NUM_LAPS, thick)
        if score(flown).success < TARGET_SUCCESS:
            break
        margin = thicker
    return margin


def measure_seed(seed: int, out: Path, config: Config) -> tuple[float, list[Any]]:
    """Return the success of one training seed, and its row of the table."""
    started = time.process_time()
    checkpoint, _ = train_policy(out / f"seed{seed}", config, seed, model=out / "model.json")
    cpu_seconds = time.process_time() - started
    env = plant_env(checkpoint, blackbox.load(SHIPPED_BLACK_BOX))
    keys = start_keys(seed, NUM_EPISODES)
    result = score(race_many(env, checkpoint.network, checkpoint.params, keys, NUM_STEPS, NUM_LAPS))
    margin, wall_s = margin_of(env, checkpoint, keys), checkpoint.meta["seconds"]
    row = [seed, f"{result.success:.1%}", f"{margin:.2f}", f"{result.gates:.2f}", f"{result.first_lap_s:.3f}"]
    return result.success, [*row, f"{result.flying_lap_s:.3f}", f"{cpu_seconds:.0f}", f"{wall_s:.0f}"]


def main() -> None:
    """Measure every seed, print and write the table; exit 1 if a seed misses the target."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="training seeds")
    parser.add_argument("--total-timesteps", type=float, default=Config.total_timesteps, help="per training")
    parser.add_argument("--gate-margin", type=float, default=Config.gate_margin, help="m; of the recipe")
    parser.add_argument("--table", type=Path, default=report.RESULTS / "learning.md", help="page to write")
    arguments = parser.parse_args()
    config = Config(total_timesteps=int(arguments.total_timesteps), gate_margin=arguments.gate_margin)
    config.check()
    out = fresh_folder(Path("runs/learning"))
    identify(SHIPPED_BLACK_BOX, out, seed=0)
    results = [measure_seed(seed, out, config) for seed in report.progress(range(arguments.seeds), "seed")]
    reached = sum(success >= TARGET_SUCCESS for success, _ in results)
    report.fill_page(
        arguments.table,
        "learning",
        table=report.table(HEADER, [row for _, row in results]),
        episodes=NUM_EPISODES,
        laps=NUM_LAPS,
        target=TARGET_SUCCESS,
        reached=reached,
        seeds=len(results),
        thicker=", ".join(f"{thicker:g}" for thicker in THICKER_M),
    )
    if reached < len(results):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
