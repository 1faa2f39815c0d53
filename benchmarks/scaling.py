"""How cost grows, and what more devices bring: ``python -m benchmarks.scaling [PART ...] [--page PAGE]``.

Rates are per second of CPU time on one core, or of wall time on an accelerator. The page is written from all
parts measured so far, which are kept in a JSON file beside it.
"""

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks import report

TABLES = ("environments", "effects", "gates", "training", "networks", "seeds")  # of scaling_rates
PROCESSES = "processes"
PARTS = (*TABLES, PROCESSES)
# Name -> processes, devices of each.
ARRANGEMENTS = {"one device": (1, 1), "two devices": (1, 2), "two processes": (2, 1), "four devices": (1, 4)}
EPISODES = 256
INTRODUCTION = """`python -m benchmarks.scaling`: how cost grows, and what more devices, processes and seeds
bring. What the figures mean, and how to train on several machines: [scaling](../scaling.md). Rates on a CPU
are million steps per second of CPU time, of one core; each is the median of five calls. Start: compilation
and the first call."""


def measure_table(name: str) -> dict[str, Any]:
    """Return a table of rates as JSON values; call it in a new process, which it pins to a core."""
    pinned = report.pin_to_one_core()
    import jax

    from benchmarks.scaling_rates import TABLES as RATES

    title, values, rate_of = RATES[name]
    device = report.cpu_name() if jax.default_backend() == "cpu" else jax.devices()[0].device_kind
    rows = [(value, *rate_of(value)) for value in report.progress(values, name)]
    return {"title": title, "rows": rows, "device": f"{device}; {pinned}", **report.provenance()}


def rate_table(result: dict[str, Any]) -> str:
    """Return a table of rates in Markdown."""
    rows = (
        (f"{value:,}" if isinstance(value, int) else value, f"{rate:.3g}", f"{start_s:.1f}")
        for value, rate, start_s in result["rows"]
    )
    return report.table((result["title"], "million steps per second", "start (s)"), rows)


def free_port() -> int:
    """Return a free port."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def train(out: Path, seed: int, steps: int, processes: int, devices: int) -> float:
    """Train in several processes of several devices each; return their CPU time, s.

    Raises:
        RuntimeError: a training failed; the message is its standard error output.
    """
    command = [sys.executable, "-m", "baselines.purejaxrl_ppo.train_ppo", "--out", str(out)]
    command += f"--seed {seed} --total-timesteps {steps} --checkpoint-every 0 --no-tracking".split()
    command += f"--evaluate-every {steps} --evaluation-episodes {EPISODES}".split()
    if processes * devices > 1:
        command.append("--distributed")
    if processes > 1:
        command += (
            f"--coordinator 127.0.0.1:{free_port()} --num-processes {processes} --process-index".split()
        )
    xla = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    environment = {**os.environ, "XLA_FLAGS": xla, "JAX_PLATFORMS": "cpu"}
    streams: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    started = os.times()
    running = [
        subprocess.Popen(
            [*command, str(index)] if processes > 1 else command, cwd=report.ROOT, env=environment, **streams
        )
        for index in range(processes)
    ]
    for process in running:
        error = process.communicate()[1]
        if process.returncode:
            raise RuntimeError(error)
    ended = os.times()
    return ended.children_user + ended.children_system - started.children_user - started.children_system


def measure_processes(folder: Path, seeds: int, steps: int) -> dict[str, Any]:
    """Train every seed in every arrangement; return the results as JSON values."""
    from baselines.purejaxrl_ppo import load_checkpoint

    rows = []
    for name, (processes, devices) in ARRANGEMENTS.items():
        results, cpu_s, started = [], 0.0, time.perf_counter()
        for seed in range(seeds):
            out = folder / f"{processes}x{devices}_{seed}"
            cpu_s += train(out, seed, steps, processes, devices)
            results.append(load_checkpoint(out / "final.safetensors").meta)
        row: dict[str, Any] = {"arrangement": name, "cpu_s": cpu_s / seeds}
        row |= {key: [result[key] for result in results] for key in ("success", "best_lap_s")}
        rows.append(row | {"wall_s": (time.perf_counter() - started) / seeds})
    title = "the same training on several devices and in several processes"
    text = process_table(rows, steps)
    return {"title": title, "text": text, "device": report.cpu_name(), "rows": rows, **report.provenance()}


def process_table(rows: list[dict[str, Any]], steps: int) -> str:
    """Return a table of what the arrangements learnt, in Markdown."""
    cells = []
    for row in rows:
        success = ", ".join(f"{share:.1%}" for share in row["success"])
        laps = ", ".join("-" if lap_s is None else f"{lap_s:.2f}" for lap_s in row["best_lap_s"])
        flown = [lap_s for lap_s in row["best_lap_s"] if lap_s is not None]
        mean_lap = f"{statistics.mean(flown):.2f}" if flown else "-"
        means = f"{success}: mean {statistics.mean(row['success']):.1%}", f"{laps}: mean {mean_lap}"
        cells.append((row["arrangement"], *means, f"{row['cpu_s']:.0f}", f"{row['wall_s']:.0f}"))
    return (
        f"`train_ppo --total-timesteps {steps}`: success of {EPISODES} noisy starts in the simulator and "
        "best lap, by seed; CPU and wall time of a training, including its start.\n\n"
        + report.table("arrangement | success, by seed | best lap (s), by seed | CPU (s) | wall (s)", cells)
    )


def as_page(results: dict[str, Any]) -> str:
    """Return the page of all parts measured so far."""
    parts = [INTRODUCTION]
    for name in PARTS:
        if name in results:
            result = results[name]
            origin = f"{result['device']}."
            if "commit" in result:
                origin += f" {report.provenance_line(result)}"
            parts += [f"## {result['title'].capitalize()}", result.get("text") or rate_table(result), origin]
    return report.page("Scaling", *parts)


def main() -> None:
    """Measure the named parts and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)} (default: all)")
    parser.add_argument("--seeds", type=int, default=3, help="of trainings on several devices")
    parser.add_argument("--steps", type=int, default=4_000_000, help="of these trainings")
    parser.add_argument("--page", type=Path, default=report.RESULTS / "scaling.md", help="page to write")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.parts if name not in PARTS]
    if unknown:
        parser.error(f"found {', '.join(unknown)}, expected parts of {', '.join(PARTS)}")
    kept = arguments.page.with_suffix(".json")
    results = json.loads(kept.read_bytes()) if kept.exists() else {}
    for name in arguments.parts or PARTS:
        if name == PROCESSES:
            with tempfile.TemporaryDirectory(prefix="flytrack_scaling_") as folder:
                results[name] = measure_processes(Path(folder), arguments.seeds, arguments.steps)
        else:
            with ProcessPoolExecutor(1, get_context("spawn")) as pool:
                results[name] = pool.submit(measure_table, name).result()
        report.write_json(kept, results)
        report.write_page(arguments.page, as_page(results))


if __name__ == "__main__":
    main()
