"""Reliability: ``python -m benchmarks.reliability [--share 1]``.

``--share 0.01`` measures a hundredth. Exits with 1 if a promise was broken.
"""

import argparse
from pathlib import Path

from benchmarks.reliability import files
from benchmarks.report import RESULTS, command_line, page, provenance, provenance_line, write_page


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="of the full measurement")
    parser.add_argument("--out", type=Path, default=RESULTS / "reliability.md", help="page to write")
    arguments = parser.parse_args()
    record = provenance()
    result = files.measure(arguments.share)
    source = f"{command_line()}. {provenance_line(record)}"
    write_page(arguments.out, page("Reliability", files.as_markdown(result), source))
    if not result["is_held"]:
        raise SystemExit("a promise was broken, see the page")


if __name__ == "__main__":
    main()
