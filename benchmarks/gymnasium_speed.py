"""Steps per second through Gymnasium and pictures per second, on one core.

``python -m benchmarks.gymnasium_speed [--repeats 7] [--out docs/results/gymnasium_speed.md]`` prints a
table and writes it. Steps and pictures count process CPU time; a video counts wall time, because
another process encodes it. Actions are drawn before the clock starts; whatever ends an episode is
part of the time. The contestants take turns, because machines drift. Needs the extra ``[dev]``.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.env_speed import MINIMUM_REPEATS, cpu_name, pin_to_one_core, versions

ENV_ID = "flytrack_env:FlyTrack-v0"
NUM_ENVS = 1024
NUM_ACTIONS = 16  # drawn in advance and flown in turn
PACKAGES = ("gymnasium", "pillow", "moviepy")


class Contestant(NamedTuple):
    """Something that does ``amount`` of its unit each time it is run; ``goal`` is wanted per second."""

    name: str
    unit: str
    goal: float
    amount: float
    clock: Callable[[], float]
    run: Callable[[], Any]


def vector_contestant(num_steps: int = 200) -> Contestant:
    """Return steps of the vector environment: NumPy in, and all that it returns."""
    import gymnasium
    import numpy as np

    envs = gymnasium.make_vec(ENV_ID, num_envs=NUM_ENVS, vectorization_mode="vector_entry_point")
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (NUM_ACTIONS, NUM_ENVS, 4)).astype(np.float32)
    envs.reset(seed=0)

    def run() -> None:
        for index in range(num_steps):
            envs.step(actions[index % NUM_ACTIONS])

    amount = num_steps * NUM_ENVS / 1e6
    name = f"vector environment, {NUM_ENVS:,}"
    return Contestant(name, "million steps per CPU s", 2.5, amount, time.process_time, run)


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

    return Contestant("single environment", "steps per CPU s", 5e3, num_steps, time.process_time, run)


def fly_slowly(env: Any, num_steps: int, see: Callable[[], Any]) -> None:
    """Fly from the start pose, begin again where an episode ends, and see every step."""
    env.reset(seed=0, options={"gate_index": 0})
    for _ in range(num_steps):
        _, _, terminated, truncated, _ = env.step((0.0, 0.01, 0.0, 0.25))
        see()
        if terminated or truncated:
            env.reset(options={"gate_index": 0})


def picture_contestant(num_steps: int = 100) -> Contestant:
    """Return pictures of every step of a flight, the steps included."""
    import gymnasium

    env = gymnasium.make(ENV_ID, render_mode="rgb_array")
    name = "rgb_array, a picture per step"

    def run() -> None:
        fly_slowly(env, num_steps, see=env.render)

    return Contestant(name, "pictures per CPU s", 100, num_steps, time.process_time, run)


def video_contestant(num_steps: int = 100) -> Contestant:
    """Return videos of a flight through ``RecordVideo``: steps, pictures and encoding."""
    import gymnasium
    from gymnasium.wrappers import RecordVideo

    def run() -> None:
        with tempfile.TemporaryDirectory() as folder:
            env = gymnasium.make(ENV_ID, render_mode="rgb_array")
            env = RecordVideo(env, f"{folder}/video", episode_trigger=lambda _: True)
            fly_slowly(env, num_steps, see=lambda: None)  # the wrapper sees to it
            env.close()

    name = "RecordVideo, a picture per step"
    return Contestant(name, "pictures per wall s", 25, num_steps, time.perf_counter, run)


def measure(entries: list[Contestant], repeats: int) -> dict[str, list[float]]:
    """Return the rates of each contestant in its unit, all taking turns, after one run to warm up."""
    for entry in entries:
        entry.run()
    rates: dict[str, list[float]] = {entry.name: [] for entry in entries}
    for _ in range(repeats):
        for entry in entries:
            start = entry.clock()
            entry.run()
            rates[entry.name].append(entry.amount / (entry.clock() - start))
    return rates


def as_number(value: float) -> str:
    """Return a rate with about three digits."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def as_markdown(entries: list[Contestant], rates: dict[str, list[float]], machine: str) -> str:
    """Return a table of medians, spreads and goals."""
    repeats = len(rates[entries[0].name])
    lines = [
        "# Speed through Gymnasium",
        "",
        f"`python -m benchmarks.gymnasium_speed --repeats {repeats}`; how to use it: docs/gymnasium.md.",
        "",
        "| what | unit | median | lowest to highest | aim |",
        "|---|---|---|---|---|",
    ]
    for entry in entries:
        found = rates[entry.name]
        median, low, high = map(as_number, (statistics.median(found), min(found), max(found)))
        lines.append(
            f"| {entry.name} | {entry.unit} | {median} | {low} to {high} | {as_number(entry.goal)} |"
        )
    return "\n".join([*lines, "", machine]) + "\n"


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7, help="rounds, at least 5")
    parser.add_argument("--out", type=Path, help="path of the table (.md)")
    arguments = parser.parse_args()
    if arguments.repeats < MINIMUM_REPEATS:
        parser.error(f"--repeats: found {arguments.repeats}, expected at least {MINIMUM_REPEATS}")
    core = pin_to_one_core()
    entries = [vector_contestant(), single_contestant(), picture_contestant(), video_contestant()]
    rates = measure(entries, arguments.repeats)
    found = versions() | {package: version(package) for package in PACKAGES}
    packages = ", ".join(f"{name} {number}" for name, number in found.items() if name != "l2f")
    machine = f"{cpu_name()}, {core}, {arguments.repeats} rounds; {packages}."
    table = as_markdown(entries, rates, machine)
    print(table, end="")
    if arguments.out:
        # Not at the top: it imports jax, whose threads must be born on the pinned core.
        from flytrack_env.files import write_atomically

        write_atomically(arguments.out, table.encode())


if __name__ == "__main__":
    main()
