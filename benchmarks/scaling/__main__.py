"""How cost grows, and what more devices bring: ``python -m benchmarks.scaling [PART ...] [--page PAGE]``.

Rates are of CPU time on one core, or of wall time on an accelerator. Parts that were measured before are
kept in a file beside the page, which is written of all of them.
"""

import argparse
import json
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks.env_speed import cpu_name, versions
from benchmarks.scaling.tables import measure_table, table
from flytrack_env.files import write_atomically

PROCESSES = "processes"
PARTS = ("environments", "effects", "gates", "training", "networks", "seeds", PROCESSES)
HEAD = """# Scaling

`python -m benchmarks.scaling`: how cost grows, and what more devices, processes and seeds bring. What the
figures mean, and how to train on several machines: [scaling](../scaling.md). Rates on a CPU: million steps
per second of CPU time, of one core; each is the median of five calls. Start: compiling, and the first call.

"""


def write_page(path: Path, results: dict[str, Any]) -> None:
    """Write the page of all parts there are."""
    text = HEAD
    for name in PARTS:
        if name in results:
            result = results[name]
            text += f"## {result['title'].capitalize()}\n\n{result.get('text') or table(result)}\n"
            text += f"{result['device']}.\n\n"
    said = ", ".join(f"{name} {number}" for name, number in versions().items())
    write_atomically(path, f"{text}{said}.\n".encode())


def main() -> None:
    """Measure the parts that are named, all without a name, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)} (default: all)")
    parser.add_argument("--seeds", type=int, default=3, help="of trainings on several devices")
    parser.add_argument("--steps", type=int, default=4_000_000, help="of these trainings")
    parser.add_argument("--page", type=Path, default=Path("docs/results/scaling.md"))
    arguments = parser.parse_args()
    unknown = [name for name in arguments.parts if name not in PARTS]
    if unknown:
        parser.error(f"found {', '.join(unknown)}, expected parts of {', '.join(PARTS)}")
    kept = arguments.page.with_suffix(".json")
    results = json.loads(kept.read_bytes()) if kept.exists() else {}
    for name in arguments.parts or PARTS:
        if name == PROCESSES:
            results[name] = measure_processes(arguments)
        else:  # in a process of its own, which is pinned to a core
            with ProcessPoolExecutor(1, get_context("spawn")) as pool:
                results[name] = pool.submit(measure_table, name).result()
        write_atomically(kept, (json.dumps(results, indent=1) + "\n").encode())
        write_page(arguments.page, results)


def measure_processes(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what trainings on several devices learn."""
    from benchmarks.scaling.processes import as_markdown, measure

    with tempfile.TemporaryDirectory(prefix="flytrack_scaling_") as folder:
        rows = measure(Path(folder), arguments.seeds, arguments.steps)
    title = "the same training on several devices and in several processes"
    return {"title": title, "text": as_markdown(rows, arguments.steps), "device": cpu_name(), "rows": rows}


if __name__ == "__main__":
    main()
