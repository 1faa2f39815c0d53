"""Steps per second through Gymnasium and pictures per second, on one core.

``python -m benchmarks.gymnasium_speed [--repeats 7] [--out docs/results/gymnasium_speed.md]`` prints a table
and writes it. Steps and pictures count process CPU time; a video counts wall time, because another process
encodes it. Actions are drawn before the clock starts; resets count. Needs the extra ``[dev]``.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import report
from benchmarks.env_speed import NUM_ACTIONS, Contestant, measure

ENV_ID = "flytrack_env:FlyTrack-v0"
NUM_ENVS = 1024


def vector_contestant(num_steps: int = 200) -> Contestant:
    """Return million steps of the vector environment: NumPy in and out."""
    import gymnasium
    import numpy as np

    envs = gymnasium.make_vec(ENV_ID, num_envs=NUM_ENVS, vectorization_mode="vector_entry_point")
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (NUM_ACTIONS, NUM_ENVS, 4)).astype(np.float32)
    envs.reset(seed=0)

    def run() -> None:
        for index in range(num_steps):
            envs.step(actions[index % NUM_ACTIONS])

    return Contestant(f"vector environment, {NUM_ENVS:,}", num_steps * NUM_ENVS / 1e6, run)


def single_contestant(num_steps: int = 2000) -> Contestant:
    """Return steps of a single environment as ``gymnasium.make`` wraps it, resets included."""
    import gymnasium
    import numpy as np

    env = gymnasium.make(ENV_ID)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (NUM_ACTIONS, 4)).astype(np.float32)
    env.reset(seed=0)

    def run() -> None:
        for index in range(num_steps):
            _, _, terminated, truncated, _ = env.step(actions[index % NUM_ACTIONS])
            if terminated or truncated:
                env.reset()

    return Contestant("single environment", num_steps, run)


def fly_slowly(env: Any, num_steps: int, after_step: Callable[[], Any]) -> None:
    """Fly from the start pose, start again where an episode ends, and call a function after every step."""
    env.reset(seed=0, options={"gate_index": 0})
    for _ in range(num_steps):
        _, _, terminated, truncated, _ = env.step((0.0, 0.01, 0.0, 0.25))
        after_step()
        if terminated or truncated:
            env.reset(options={"gate_index": 0})


def picture_contestant(num_steps: int = 100) -> Contestant:
    """Return pictures of every step of a flight, the steps included."""
    import gymnasium

    env = gymnasium.make(ENV_ID, render_mode="rgb_array")
    return Contestant(
        "rgb_array, a picture per step", num_steps, lambda: fly_slowly(env, num_steps, env.render)
    )


def video_contestant(num_steps: int = 100) -> Contestant:
    """Return pictures of videos of a flight through ``RecordVideo``: steps, rendering and encoding."""
    import gymnasium
    from gymnasium.wrappers import RecordVideo

    def run() -> None:
        with tempfile.TemporaryDirectory() as folder:
            env = gymnasium.make(ENV_ID, render_mode="rgb_array")
            env = RecordVideo(env, f"{folder}/video", episode_trigger=lambda _: True)
            fly_slowly(env, num_steps, lambda: None)  # the wrapper renders
            env.close()

    return Contestant("RecordVideo, a picture per step", num_steps, run, time.perf_counter)


# Contestant, unit of its rate, aim.
CONTESTANTS: tuple[tuple[Callable[[], Contestant], str, float], ...] = (
    (vector_contestant, "million steps per CPU s", 2.5),
    (single_contestant, "steps per CPU s", 5e3),
    (picture_contestant, "pictures per CPU s", 100),
    (video_contestant, "pictures per wall s", 25),
)


def as_number(value: float) -> str:
    """Return a rate with about three digits."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7, help="rounds, at least 5 for figures to publish")
    parser.add_argument("--out", type=Path, help="path of the page (.md)")
    arguments = parser.parse_args()
    core = report.pin_to_one_core()
    entries = [make() for make, _, _ in CONTESTANTS]
    rates = measure(entries, arguments.repeats, warm_up=1)
    rows = []
    for (_, unit, aim), (name, values) in zip(CONTESTANTS, rates.items(), strict=True):
        median, low, high = map(as_number, (statistics.median(values), min(values), max(values)))
        rows.append((name, unit, median, f"{low} to {high}", as_number(aim)))
    record = report.provenance("gymnasium", "pillow", "moviepy")
    text = report.page(
        "Speed through Gymnasium",
        f"{report.command_line()}; how to use it: docs/gymnasium.md.",
        report.table("what | unit | median | lowest to highest | aim", rows),
        f"{arguments.repeats} rounds, {core}. {report.provenance_line(record)}",
    )
    report.write_page(arguments.out, text)


if __name__ == "__main__":
    main()
