"""Measures parts of the reliability page: ``python -m benchmarks.reliability PART ... [--share 1]``.

Each part's figures are kept in ``reliability_<part>.json`` beside the page, which is written of all that
there are. ``--share 0.01`` measures a hundredth of everything, to try it out. Ends with 1 where a promise
was broken.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.env_speed import cpu_name, versions
from benchmarks.reliability import determinism, files, memory, simulation, training
from benchmarks.reliability.section import Section
from flytrack_env.files import write_atomically

SECTIONS: tuple[Section, ...] = (
    simulation.SECTION,
    training.SECTION,
    files.SECTION,
    memory.SECTION,
    determinism.SECTION,
)
RESULTS = Path("docs/results")
PAGE = """# Reliability

What was tried to break it, and what came of it. Every part names its command and machine.

"""


def path_of(folder: Path, section: Section) -> Path:
    """Return where a part's figures are kept."""
    return folder / f"reliability_{section.name}.json"


def measure(section: Section, seed: int, share: float) -> dict[str, Any]:
    """Return a part's figures, with the command and the machine that they come from."""
    started_s = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="flytrack_reliability_") as folder:
        result = section.measure(seed, share, Path(folder))
    return {
        "command": f"python -m benchmarks.reliability {section.name} --seed {seed} --share {share:g}",
        "machine": f"{cpu_name()}; {', '.join(f'{name} {number}' for name, number in versions().items())}",
        "minutes": round((time.perf_counter() - started_s) / 60.0, 1),
        **result,
    }


def write_page(folder: Path) -> None:
    """Write the page of all figures in a folder."""
    text = PAGE
    for section in SECTIONS:
        path = path_of(folder, section)
        if path.exists():
            result = json.loads(path.read_bytes())
            source = f"`{result['command']}`: {result['minutes']:g} min. {result['machine']}."
            text += f"## {section.title}\n\n{section.as_markdown(result)}\n{source}\n\n"
    write_atomically(folder / "reliability.md", (text.rstrip() + "\n").encode())


def main() -> None:
    """Measure the parts that are named, write their figures and the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    by_name = {section.name: section for section in SECTIONS}
    names = ", ".join(by_name)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {names}; none: only the page")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--share", type=float, default=1.0, help="of the full measurement (default: 1)")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the page (default: %(default)s)")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.parts if name not in by_name]
    if unknown or not 0.0 < arguments.share <= 1.0:
        parser.error(f"found {unknown or arguments.share}, expected parts of {names}, a share in (0, 1]")
    broken = []
    for name in arguments.parts:
        section = by_name[name]
        result = measure(section, arguments.seed, arguments.share)
        content = json.dumps(result, indent=2) + "\n"
        write_atomically(path_of(arguments.out, section), content.encode())
        print(section.as_markdown(result))
        broken += [] if section.is_held(result) else [name]
    write_page(arguments.out)
    if broken:
        raise SystemExit(f"promises broken: {', '.join(broken)}")


if __name__ == "__main__":
    main()
