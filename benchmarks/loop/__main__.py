"""Does the diagnosis make better policies? ``python -m benchmarks.loop [--plants 5 | --laws 10]``.

Closes the loop (``flytrack_loop.close_loop``) on the shipped black box and on plants with hidden effects
drawn from the seed, or on plants with a law outside the package's list, and trains three alternatives with as
many steps: on the nominal model, on the refitted base model, and on randomised models without any
identification. One process per core. Writes a page and a chart; finished jobs are not run again.
"""

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from tqdm import tqdm

from baselines.purejaxrl_ppo import Config
from benchmarks.loop.jobs import LAW, LOG, SHARED, pin, run_job
from benchmarks.loop.page import write_page


def jobs_of(arguments: argparse.Namespace) -> list[str]:
    """Return the jobs that need a plant."""
    if arguments.laws:
        return [f"{LAW}{number}" for number in range(arguments.laws)]
    return ["shipped", *map(str, range(arguments.plants))]


def run_all(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the results of all plants whose jobs succeeded."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
    context = get_context("spawn")
    free_cores = context.Queue()
    for core in cores:
        free_cores.put(core)
    plants = jobs_of(arguments)
    results: dict[str, dict[str, Any]] = {}
    with ProcessPoolExecutor(len(cores), context, initializer=pin, initargs=(free_cores,)) as pool:
        for jobs in (list(SHARED), plants):  # every plant needs both shared policies
            rest = arguments.out.resolve(), arguments.steps, arguments.seed
            running = {job: pool.submit(run_job, job, *rest) for job in jobs}
            for job, future in tqdm(running.items(), unit="job"):
                try:
                    results[job] = future.result()
                except Exception as error:
                    tqdm.write(f"{job}: failed, see {arguments.out / job / LOG}: {error}")
                    if job in SHARED:
                        raise SystemExit(1) from None
    return [result for job, result in results.items() if job not in SHARED]


def main() -> None:
    """Run what is missing, print and write the page; exit 1 where a job failed or the aim is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plants", type=int, default=5, help="with hidden effects, beside the shipped one")
    parser.add_argument("--laws", type=int, default=0, help="plants with a law outside the list, instead")
    parser.add_argument("--seed", type=int, default=0, help="of plants, trainings, logs and evaluations")
    parser.add_argument("--steps", type=int, default=Config.total_timesteps, help="of every training")
    parser.add_argument("--out", type=Path, default=Path("runs/loop"), help="folder of all runs")
    parser.add_argument("--page", type=Path, help="default: loop.md in the folder of the runs")
    arguments = parser.parse_args()
    results = run_all(arguments)
    is_met = write_page(arguments.page or arguments.out / "loop.md", results, arguments.steps)
    if len(results) < len(jobs_of(arguments)) or not is_met:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
