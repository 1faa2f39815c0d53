"""Steps per second through Gymnasium, on one core.

``python -m benchmarks.gymnasium_speed [--repeats 7] [--out docs/results/gymnasium_speed.md]`` prints a table
and writes it. Actions are drawn before the clock starts; resets count.
"""

import argparse
import statistics
from pathlib import Path

import gymnasium
import numpy as np

from benchmarks import report
from benchmarks.env_speed import NUM_ACTIONS, Contestant, measure

ENV_ID = "flytrack_env:FlyTrack-v0"
NUM_ENVS = 1024
VECTOR, SINGLE = f"vector environment, {NUM_ENVS:,}", "single environment"
AIMS = {VECTOR: 2.5, SINGLE: 0.005}  # million steps per CPU second


def vector_contestant(num_steps: int = 200) -> Contestant:
    """Return million steps of the vector environment: NumPy in and out."""
    envs = gymnasium.make_vec(ENV_ID, num_envs=NUM_ENVS, vectorization_mode="vector_entry_point")
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (NUM_ACTIONS, NUM_ENVS, 4)).astype(np.float32)
    envs.reset(seed=0)

    def run() -> None:
        for index in range(num_steps):
            envs.step(actions[index % NUM_ACTIONS])

    return Contestant(VECTOR, num_steps * NUM_ENVS / 1e6, run)


def single_contestant(num_steps: int = 2000) -> Contestant:
    """Return million steps of a single environment as ``gymnasium.make`` wraps it, resets included."""
    env = gymnasium.make(ENV_ID)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (NUM_ACTIONS, 4)).astype(np.float32)
    env.reset(seed=0)

    def run() -> None:
        for index in range(num_steps):
            _, _, terminated, truncated, _ = env.step(actions[index % NUM_ACTIONS])
            if terminated or truncated:
                env.reset()

    return Contestant(SINGLE, num_steps / 1e6, run)


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7, help="rounds, at least 5 for figures to publish")
    parser.add_argument("--out", type=Path, help="path of the page (.md)")
    arguments = parser.parse_args()
    core = report.pin_to_one_core()
    rates = measure([vector_contestant(), single_contestant()], arguments.repeats, warm_up=1)
    rows = [
        (name, f"{statistics.median(values):,.3g}", report.spread(values, ",.3g"), f"{AIMS[name]:g}")
        for name, values in rates.items()
    ]
    table = report.table("what | million steps per CPU s, median | lowest to highest | aim", rows)
    counts = {"repeats": arguments.repeats, "core": core}
    report.fill_page(arguments.out, "gymnasium_speed", ["gymnasium"], table=table, **counts)


if __name__ == "__main__":
    main()
