"""Does the diagnosis make better policies? ``python -m benchmarks.loop [--plants 5 | --laws 10]``.

Closes the loop (``flytrack_loop.close_loop``) on the shipped black box and on plants with hidden
effects drawn from the seed, or on plants with a law outside the package's list, and trains three
alternatives with as many steps: on the nominal model, on the refitted base model, and on randomised
models without any identification. One process per core, or tasks of a Ray cluster. Writes a page,
a chart and their records, a .jsonl; finished jobs are not run again. ``--redraw
docs/results/loop.jsonl`` runs nothing: it writes the page and the chart beside such records.
"""

import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from baselines.purejaxrl_ppo import Config
from benchmarks.loop.jobs import LAW, SHARED, run_job
from benchmarks.loop.page import read_records, write_page, write_records
from benchmarks.report import command, command_line, progress, provenance, provenance_line
from flytrack_env.jobs import run_jobs

LIMIT_S = 86_400.0  # of a job, with its trainings


def run_all(
    plants: list[str], out: Path, steps: int, seed: int, address: str | None
) -> list[dict[str, Any]]:
    """Return the results of all plants; the first error of a job ends all of them."""
    has_affinity = hasattr(os, "sched_getaffinity")
    workers = len(os.sched_getaffinity(0)) if has_affinity else 1

    def run(names: Iterable[str]) -> dict[str, Any]:
        jobs = {name: (name, out.resolve(), steps, seed) for name in names}
        results = {}
        outcomes = run_jobs(run_job, jobs, LIMIT_S, address, workers)
        for name, outcome in progress(outcomes, "jobs", len(jobs)):
            if outcome.error:
                raise RuntimeError(f"job {name}: {outcome.error}; more in {out / name}")
            results[name] = outcome.value
        return results

    run(SHARED)  # every plant needs both shared policies
    results = run(plants)
    return [results[name] for name in plants]


def main(
    plants: int = 5,
    laws: int = 0,
    seed: int = 0,
    steps: int = Config.total_timesteps,
    out: Path = Path("runs/loop"),
    page: Path | None = None,
    redraw: Path | None = None,
    address: str | None = None,
) -> None:
    """Run what is missing, print and write the page; exit 1 on a missed target.

    Args:
        plants: with hidden effects, beside the shipped one.
        laws: plants with a law outside the list, instead.
        seed: of plants, trainings, logs and evaluations.
        steps: of every training.
        out: folder of all runs.
        page: by default loop.md in it.
        redraw: records to write the page of, instead, beside them.
        address: of a Ray cluster, whose nodes see this checkout and the folder of runs under the
            same paths; by default processes of this machine.
    """
    if redraw is not None and page is not None:
        sys.exit("--page: found together with --redraw, which writes the page beside the records")
    if redraw is not None:
        about, results = read_records(redraw)
        path = redraw.with_suffix(".md")
    else:
        jobs = [f"{LAW}{number}" for number in range(laws)] or ["shipped", *map(str, range(plants))]
        results = run_all(jobs, out, steps, seed, address)
        about = {
            "command": command_line(),
            "steps": steps,
            "cpu_min": sum(result["cpu_s"] for result in results) / 60.0,
            "provenance": provenance_line(provenance()),
        }
        path = page or out / "loop.md"
        write_records(path.with_suffix(".jsonl"), results, about)
    if not write_page(path, results, about):
        raise SystemExit(1)


if __name__ == "__main__":
    command(main)
