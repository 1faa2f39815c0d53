"""Beyond one machine: ``python -m benchmarks.scaling devices|fleet|cluster|overhead|page``.

``devices`` trains on one device, on several, and in two processes. ``fleet`` flies craft whose
equations share nothing with the package (benchmarks.hidden), and lets the fleet's diagnosis say
which cause began when. ``cluster`` kills a node of a simulated Ray cluster under a sweep and a
fleet. ``overhead`` compares Ray with a plain loop. Each appends its record to
docs/results/scaling.jsonl; ``page`` writes docs/results/scaling.md from the last of each.
"""

import math
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks import hidden
from benchmarks.diagnosis import model_of
from benchmarks.hidden.draws import SUDDEN
from benchmarks.report import RESULTS, append_line, command, progress, provenance
from flytrack_env.model_file import save_model
from flytrack_sysid.fleet import Change, diagnose_fleet, find_flights
from flytrack_sysid.fleet_page import write_fleet
from flytrack_sysid.log_file import save_log

LINES, RUNS = RESULTS / "scaling.jsonl", Path("runs/scaling")
SEED = 61  # no rule was made on it
BEGINS_IN = 12  # flight
WITH_CAUSE = 3  # craft
LIMIT_S = 900.0


def draw_craft(rng: np.random.Generator, has_cause: bool) -> tuple[hidden.Truth, hidden.Truth]:
    """Return a plant, and what it is from ``BEGINS_IN`` on: with a cause of the larger sizes."""
    truth = replace(hidden.draw_base(rng), motion="fine")
    name = str(rng.choice(SUDDEN))
    drawn = hidden.EFFECTS[name]
    size = hidden.log_uniform(math.sqrt(drawn.low * drawn.high), drawn.high, rng)
    effects = {name: hidden.draw_effect(name, rng, size)}
    return truth, replace(truth, effects=effects) if has_cause else truth


def fly_fleet(folder: Path, craft: int, flights: int, seconds: float, seed: int) -> dict[str, Any]:
    """Write the logs of a fleet, a subfolder a craft with its model, and return the true causes."""
    causes = {}
    for number in progress(range(craft), "craft"):
        rng = np.random.default_rng([seed, number])
        before, after = draw_craft(rng, number < WITH_CAUSE)
        home = folder / f"craft{number:02d}"
        home.mkdir(parents=True, exist_ok=True)
        save_model(home / "model.json", model_of(before), {})
        causes[home.name] = sorted(after.effects)
        for flight in range(1, flights + 1):
            path, truth = home / f"flight{flight:02d}.npz", after if flight >= BEGINS_IN else before
            of_flight = np.random.default_rng([seed, number, flight])
            if not path.exists():
                log = hidden.fly(truth, seconds, of_flight)
                save_log(path, hidden.measure(log, "sensors", of_flight))
    return causes


def grade(changes: list[Change], causes: dict[str, list[str]]) -> dict[str, Any]:
    """Return which changes a fleet's diagnosis told, and which of them are so."""
    told = [
        {
            "craft": one.craft,
            "causes": list(one.causes),
            "flight": one.flight,
            "truth": causes[one.craft],
        }
        for one in changes
        if one.causes
    ]
    right = [one for one in told if one["causes"] == one["truth"] and one["flight"] == BEGINS_IN]
    return {
        "told": told,
        "right": len(right),
        "of": sum(map(bool, causes.values())),
        "other": len(told) - len(right),
    }


def run_fleet(craft: int, flights: int, seconds: float, seed: int) -> dict[str, Any]:
    """Return how a simulated fleet was told."""
    folder, out = RUNS / f"fleet{seed}", RUNS / f"told{seed}"
    causes = fly_fleet(folder, craft, flights, seconds, seed)
    found = find_flights([folder], None)
    started, used = time.perf_counter(), sum(os.times()[:4])
    results, changes = diagnose_fleet(found, out, LIMIT_S, 1)
    write_fleet(out, found, results, changes)
    return {
        "craft": craft,
        "flights": flights,
        "seconds": seconds,
        "seed": seed,
        "wall_s": round(time.perf_counter() - started),
        "cpu_s": round(sum(os.times()[:4]) - used),
        **grade(changes, causes),
    }


def main(
    part: Literal["fleet"],
    craft: int = 8,
    flights: int = 15,
    seconds: float = 20.0,
    seed: int = SEED,
) -> None:
    """Measure a part.

    Args:
        part: what is measured.
        craft: of the fleet.
        flights: of each.
        seconds: of each flight.
        seed: of plants, flights and trainings.
    """
    record = run_fleet(craft, flights, seconds, seed)
    append_line(LINES, {"part": part, **record, **provenance()})
    print(record)


if __name__ == "__main__":
    command(main)
