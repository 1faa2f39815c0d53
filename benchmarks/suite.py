"""The suite of ``flytrack_bench``: ``python -m benchmarks.suite [--draw] [--page]``.

``--draw`` draws the tracks and hidden plants of suite v1 from its seed and writes them; a test
compares them with those that are shipped. ``--page`` writes docs/benchmark.md of the results in
docs/results/suite, which ``flytrack bench`` wrote.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

from benchmarks import report
from benchmarks.loop.plants import draw_plant
from flytrack_bench.suite import FOLDER, craft_as_json, digest_of
from flytrack_env import Track, load_track, random_track, save_track
from flytrack_env.references import shipped_reference, track_digest

SEED, START_SEED = 2026, 7
TRACK_SEEDS = {"random_1": 101, "random_2": 102, "random_3": 103}
# python -m benchmarks.time_optimal --tracks flytrack_bench/suites/v1/random_{1,2,3}.toml --kinds
# flying
OPTIMAL_S = {"random_1": 4.4545, "random_2": 6.2877, "random_3": 5.8095}
PLANTS = range(3, 11)  # of ``draw_plant``: two, three and five effects each
RESULTS = report.RESULTS / "suite"
PAGE = report.ROOT / "docs" / "benchmark.md"


def draw_suite(folder: Path) -> None:
    """Write suite v1 into a folder: its tracks and its file."""
    for name, seed in TRACK_SEEDS.items():
        track = dataclasses.replace(random_track(seed), name=name)
        save_track(folder / "v1" / f"{name}.toml", track)
    flytrack, optimal_s = load_track("flytrack"), shipped_reference("flytrack").time_s
    tasks = [_task("flytrack", "flytrack", flytrack, optimal_s)]
    for name, time_s in OPTIMAL_S.items():
        file = f"v1/{name}.toml"
        tasks.append(_task(name, file, load_track(folder / file), time_s))
    for number, plant in enumerate(PLANTS, 1):
        craft = craft_as_json(draw_plant(plant, SEED))
        tasks.append(_task(f"plant_{number}", "flytrack", flytrack, optimal_s, craft))
    content: dict[str, Any] = {
        "name": "v1",
        "seed": START_SEED,
        "starts": 256,
        "laps": 3,
        "steps": 2500,
        "tasks": tasks,
    }
    report.write_json(folder / "v1.json", {"digest": digest_of(content), **content})


def _task(
    name: str, file: str, track: Track, optimal_s: float, craft: Any = None
) -> dict[str, Any]:
    return {
        "id": name,
        "track": file,
        "track_sha256": track_digest(track),
        "optimal_lap_s": round(optimal_s, 6),
        "craft": craft,
    }


def row(path: Path) -> list[str]:
    """Return an entry's row of the table."""
    entry = json.loads(path.read_text(encoding="utf-8"))
    flights = entry["tasks"]

    def mean(tasks: list[str], name: str, digits: str) -> str:
        values = [
            flight[name]
            for task in tasks
            for flight in flights.get(task, ())
            if flight[name] is not None
        ]
        return format(sum(values) / len(values), digits) if values else "-"

    plants = [f"plant_{number}" for number in range(1, len(PLANTS) + 1)]
    cells = [
        f"{mean(tasks, 'success', '.1%')}, {mean(tasks, 'over_optimal', '.3f')}"
        for tasks in (["flytrack"], list(TRACK_SEEDS), plants)
    ]
    score = entry["summary"]["score"]
    interval = "" if score["ci95"] is None else " ({:.3f} to {:.3f})".format(*score["ci95"])
    is_whole = len(flights) > len(PLANTS)
    return [
        f"[{path.stem}](results/suite/{path.name})",
        entry["regime"],
        str(len(entry["policies"])),
        *cells,
        f"{score['interquartile_mean']:.3f}{interval}" if is_whole else "-",
    ]


def write_page() -> None:
    """Write the page of all results."""
    header = (
        "entry | regime | seeds | FlyTrack course | random tracks | hidden plants | "
        "interquartile mean of the score"
    )
    rows = [row(path) for path in sorted(RESULTS.glob("*.json"))]
    report.fill_page(PAGE, "benchmark", results=report.table(header, rows))


def main(draw: bool = False, page: bool = False) -> None:
    """Write the suite's files, or docs/benchmark.md."""
    if draw:
        draw_suite(FOLDER)
    if page:
        write_page()


if __name__ == "__main__":
    report.command(main)
