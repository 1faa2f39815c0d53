"""Reliability: ``python -m benchmarks.reliability simulation|training|files [--share 1]``.

Each part's result is kept in ``docs/results/reliability_<part>.json``; the page is written from all of them.
``--share 0.01`` measures a hundredth. Exits with 1 if a promise was broken.
"""

import argparse
import json
from pathlib import Path

from benchmarks.reliability import files, simulation, training
from benchmarks.report import RESULTS, command_line, page, provenance, provenance_line, write_json, write_page

PARTS = {"simulation": simulation, "training": training, "files": files}


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
    """Measure a part; write its result and the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--share", type=float, default=1.0, help="of the full measurement")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    arguments = parser.parse_args()
    result = {**provenance(), "command": command_line(), **PARTS[arguments.part].measure(arguments.share)}
    write_json(arguments.out / f"reliability_{arguments.part}.json", result)
    write_page(arguments.out / "reliability.md", page_of(arguments.out))
    if not result["is_held"]:
        raise SystemExit(f"{arguments.part}: a promise was broken, see the page")


if __name__ == "__main__":
    main()
