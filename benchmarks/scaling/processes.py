"""The same training on one device, on several, and in two processes: does it learn the same?"""

import os
import socket
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from baselines.purejaxrl_ppo import load_checkpoint
from benchmarks.flown import ROOT

ARRANGEMENTS = {"one device": (1, 1), "two devices": (1, 2), "two processes": (2, 1), "four devices": (1, 4)}
EPISODES = 256


def free_port() -> int:
    """Return a port that nobody listens at."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def train(out: Path, seed: int, steps: int, processes: int, devices: int) -> float:
    """Train in processes of so many devices each; return the CPU time of all, s."""
    port = free_port()
    flags = f"--seed {seed} --total-timesteps {steps} --checkpoint-every 0 --no-tracking"
    evaluation = f"--evaluate-every {steps} --evaluation-episodes {EPISODES}"
    command = [sys.executable, "-m", "baselines.purejaxrl_ppo.train_ppo", "--out", str(out)]
    command += [*flags.split(), *evaluation.split()]
    if processes * devices > 1:
        command.append("--distributed")
    xla = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    started = os.times()
    running = []
    for index in range(processes):
        job = f"--coordinator 127.0.0.1:{port} --num-processes {processes} --process-index {index}".split()
        running.append(
            subprocess.Popen(
                [*command, *(job if processes > 1 else [])],
                cwd=ROOT,
                env={**os.environ, "XLA_FLAGS": xla, "JAX_PLATFORMS": "cpu"},
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
    for one in running:
        said = one.communicate()[1]
        if one.returncode:
            raise RuntimeError(said)
    ended = os.times()
    return ended.children_user + ended.children_system - started.children_user - started.children_system


def learned(out: Path) -> tuple[float, float]:
    """Return success and the best flying lap so far, s, of the evaluation at the end of a training."""
    seen = load_checkpoint(out / "final.msgpack").meta["seen"]
    return float(seen["success"]), float(seen["best_lap_s"] or np.nan)


def measure(folder: Path, seeds: int, steps: int) -> list[dict[str, Any]]:
    """Train every seed in every arrangement; return what came of it."""
    rows = []
    for name, (processes, devices) in ARRANGEMENTS.items():
        results, cpu_s, started = [], 0.0, time.perf_counter()
        for seed in range(seeds):
            out = folder / f"{processes}x{devices}_{seed}"
            cpu_s += train(out, seed, steps, processes, devices)
            results.append(learned(out))
        success, laps_s = zip(*results, strict=True)
        rows.append(
            {
                "arrangement": name,
                "success": success,
                "best_lap_s": laps_s,
                "cpu_s": cpu_s / seeds,
                "wall_s": (time.perf_counter() - started) / seeds,
            }
        )
    return rows


def as_markdown(rows: list[dict[str, Any]], steps: int) -> str:
    """Return a table of what the arrangements learnt."""
    lines = [
        f"`train_ppo --total-timesteps {steps}`: success of {EPISODES} noisy starts in the simulator, and "
        "the best lap, by seed; CPU and wall time of a training, with all that it begins with.",
        "",
        "| arrangement | success, by seed | best lap (s), by seed | CPU (s) | wall (s) |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        success = ", ".join(f"{one:.1%}" for one in row["success"])
        laps = ", ".join(f"{one:.2f}" for one in row["best_lap_s"])
        mean = f"{statistics.mean(row['success']):.1%}", f"{statistics.mean(row['best_lap_s']):.2f}"
        lines.append(
            f"| {row['arrangement']} | {success}: mean {mean[0]} | {laps}: mean {mean[1]} | "
            f"{row['cpu_s']:.0f} | {row['wall_s']:.0f} |"
        )
    return "\n".join(lines) + "\n"
