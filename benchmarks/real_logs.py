"""The diagnosis of measured flights of five drones, and models judged on policies left out.

``python -m benchmarks.real_logs --diagnose crazyflie,payload,nanobench,gecko,betaflight [--data
../shared/data]`` diagnoses flights and keeps the records in benchmarks/data/real; without
``--diagnose``, docs/results/real_logs_diagnosis.md and its pictures are made of the records there
and of those of ``python -m benchmarks.real.crazyflie``. Where the data or the reader of Betaflight
logs are absent, it says so and writes nothing.
"""

import json
import sys
from pathlib import Path

from benchmarks.real.crafts import CRAFTS
from benchmarks.real.crazyflie import DATA, LINES, VARIABLE, crazyflie_part
from benchmarks.real.section import draw_errors, format_section
from benchmarks.report import RESULTS, command, filled, write_json
from flytrack_env.files import write_atomically
from flytrack_env.pictures.drawing import png_of
from flytrack_sysid import LogError

RESULT = RESULTS / "real_logs_diagnosis.md"
NO_RECORD = "Not on record; `python -m benchmarks.real_logs --diagnose {craft}` makes one."


def record_path(craft: str) -> Path:
    """Return the file that keeps a craft's record."""
    return LINES.with_name(f"{craft}_diagnosis.json")


def page() -> tuple[str, dict[str, bytes]]:
    """Return the page on what is on record, and its pictures by file."""
    parts, pictures = [filled("real_logs"), crazyflie_part()], {}
    for name, craft in CRAFTS.items():
        parts.append(f"## {craft.title}")
        if not record_path(name).exists():
            parts.append(NO_RECORD.format(craft=name))
            continue
        measured = json.loads(record_path(name).read_text(encoding="utf-8"))
        parts.append(craft.part(measured))
        for number, (title, one) in enumerate(craft.diagnoses(measured).items()):
            file, figure = f"real_{name}_{number}.png", draw_errors(one)
            parts += [f"### {title}" if title else "", format_section(one, file)]
            if figure is not None:
                pictures[file] = png_of(figure)
    return "\n\n".join(part.strip("\n") for part in parts if part) + "\n", pictures


def main(data: Path = DATA, diagnose: str = "") -> None:
    """Diagnose, or write the page, or say why not."""
    for name in filter(None, diagnose.split(",")):
        folder = data / CRAFTS[name].folder
        if not folder.is_dir():
            sys.exit(
                f"skipped: no measured flights at {folder}; --data or {VARIABLE} names their folder"
            )
        try:
            write_json(record_path(name), CRAFTS[name].measure(data))
        except LogError as error:
            sys.exit(f"skipped: {error}")
    if not diagnose:
        text, pictures = page()
        for file, content in {RESULT.name: text.encode(), **pictures}.items():
            write_atomically(RESULT.with_name(file), content)
        print(f"written: {RESULT}, {', '.join(pictures)}")


if __name__ == "__main__":
    command(main)
