"""Does the diagnosis make better policies? ``python -m benchmarks.loop [--plants 5] [--page PAGE]``.

Closes the loop (``flytrack_loop.close_loop``) on the shipped black box and on plants with hidden effects that
are drawn from the seed, and trains three alternatives with as many steps: on the nominal model, on the
refitted base model, and on randomised models without any identification. One process per core. Writes a page
and a chart; jobs whose result is there already are not done again.
"""

import argparse
import json
import os
import queue
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tqdm import tqdm

from baselines.purejaxrl_ppo import Config
from benchmarks.flown import ROOT
from benchmarks.loop.one import RESULT, SHARED
from benchmarks.loop.page import write_page

LOG = "log.txt"


def run_job(job: str, cores: "queue.Queue[int]", arguments: argparse.Namespace) -> dict[str, Any] | None:
    """Run a job on a free core and return its result; None where it failed, and its log says why."""
    folder = arguments.out / job
    if not (folder / RESULT).exists():
        if (folder / LOG).exists():  # a job that was cut off: its trainings would be refused as another run's
            shutil.rmtree(folder)
        folder.mkdir(parents=True, exist_ok=True)
        core = cores.get()
        flags = ["--core", core, "--seed", arguments.seed, "--steps", arguments.steps]
        command = [sys.executable, "-m", "benchmarks.loop.one", job, arguments.out.resolve(), *flags]
        try:
            with (folder / LOG).open("wb") as log:
                done = subprocess.run([*map(str, command)], cwd=ROOT, stdout=log, stderr=subprocess.STDOUT)
        finally:
            cores.put(core)
        if done.returncode:
            tail = (folder / LOG).read_text(errors="replace").splitlines()[-1:]
            tqdm.write(f"{job}: failed, {folder / LOG}: {''.join(tail)}")
            return None
    return json.loads((folder / RESULT).read_text())


def run_all(arguments: argparse.Namespace) -> tuple[list[dict[str, Any]], float]:
    """Return the results of all plants, and how long that took, s."""
    started_s = time.perf_counter()
    names = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
    cores: queue.Queue[int] = queue.Queue()
    for core in names:
        cores.put(core)
    plants = ["shipped", *map(str, range(arguments.plants))]
    results = []
    with (
        ThreadPoolExecutor(len(names)) as pool,
        tqdm(total=len(SHARED) + len(plants), unit="job") as bar,
    ):
        for jobs in (list(SHARED), plants):  # every plant needs both of the first
            for result in pool.map(lambda job: run_job(job, cores, arguments), jobs):
                bar.update()
                if result is None and jobs[0] in SHARED:
                    raise SystemExit(1)
                results += [result] if result is not None else []
    return [one for one in results if one["job"] not in SHARED], time.perf_counter() - started_s


def main() -> None:
    """Run what is missing, print and write the page; exit 1 where a job failed or the aim is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plants", type=int, default=5, help="with hidden effects, beside the shipped one")
    parser.add_argument("--seed", type=int, default=0, help="of plants, trainings, logs and evaluations")
    parser.add_argument("--steps", type=int, default=Config.total_timesteps, help="of every training")
    parser.add_argument("--out", type=Path, default=Path("runs/loop"), help="folder of all runs")
    parser.add_argument("--page", type=Path, help="default: loop.md in the folder of the runs")
    arguments = parser.parse_args()
    if arguments.plants < 0:
        parser.error(f"--plants: found {arguments.plants}, expected 0 or more")
    results, wall_s = run_all(arguments)
    is_met = write_page(arguments.page or arguments.out / "loop.md", results, arguments, wall_s)
    if len(results) <= arguments.plants or not is_met:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
