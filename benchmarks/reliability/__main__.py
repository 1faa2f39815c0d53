"""Reliability: ``python -m benchmarks.reliability simulation|training|files [--share 1]``.

Each part's result is kept in ``docs/results/reliability_<part>.json``; the page is written from all of them.
``--share 0.01`` measures a hundredth. Exits with 1 if a promise was broken.
"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.reliability import files, simulation, training
from benchmarks.report import RESULTS, command_line, page, provenance, provenance_line, write_json, write_page

NUM_STEPS, KILLS, NUM_FILES = 1e8, 10, 1000  # files: of each kind
PARTS = {"simulation": simulation, "training": training, "files": files}


def measure(part: str, share: float) -> dict[str, Any]:
    """Return the result of a part."""
    if part == "simulation":
        return simulation.measure(share * NUM_STEPS)
    if part == "files":
        return files.measure(max(round(share * NUM_FILES), 1))
    with tempfile.TemporaryDirectory() as folder:
        return training.measure(max(round(share * KILLS), 1), Path(folder))


def page_of(folder: Path) -> str:
    """Return the page of all results in a folder."""
    texts = []
    for part, module in PARTS.items():
        path = folder / f"reliability_{part}.json"
        if path.exists():
            result = json.loads(path.read_bytes())
            source = f"{result['command']}. {provenance_line(result)}"
            texts.append(f"## {part.capitalize()}\n\n{module.as_markdown(result)}\n\n{source}")
    return page("Reliability", *texts)


def main() -> None:
    """Measure a part, or none; write its result and the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", nargs="?", choices=PARTS, help="none: write the page from kept results")
    parser.add_argument("--share", type=float, default=1.0, help="of the full measurement")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    arguments = parser.parse_args()
    is_held = True
    if arguments.part:
        result = {**provenance(), "command": command_line(), **measure(arguments.part, arguments.share)}
        write_json(arguments.out / f"reliability_{arguments.part}.json", result)
        is_held = result["is_held"]
    write_page(arguments.out / "reliability.md", page_of(arguments.out))
    if not is_held:
        raise SystemExit(f"{arguments.part}: a promise was broken, see the page")


if __name__ == "__main__":
    main()
