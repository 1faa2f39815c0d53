"""The diagnosis of measured flights of five drones, and models judged on policies left out.

``python -m benchmarks.real_logs --diagnose crazyflie,payload,nanobench,gecko,betaflight [--data
../shared/data]`` diagnoses flights and keeps the records in benchmarks/data/real; without ``--diagnose``,
docs/results/real_logs_diagnosis.md and its pictures are made of the records there and of those of
``python -m benchmarks.real.crazyflie``. Where the data or the reader of Betaflight logs are absent, it says
so and writes nothing.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.real import gecko, nanobench, payload
from benchmarks.real.crazyflie import DATA, FOLDER, LINES, VARIABLE, crazyflie_part, flights
from benchmarks.real.section import Record, diagnosed, draw, imported, section
from benchmarks.report import RESULTS, ROOT, command, write_json
from flytrack_env.files import write_atomically
from flytrack_env.pictures.drawing import png_of
from flytrack_sysid import LogError
from flytrack_sysid.diagnosis import joined

RESULT = RESULTS / "real_logs_diagnosis.md"
BETAFLIGHT = "betaflight_acro_log"
# Every third policy, by its number, is for judging.
LEARNT = ("48", "49", "52", "53", "67", "68", "70", "71")
JUDGED = ("50", "66", "69")
QUAD = """[rows]
from_s = 2.0  # it stands on the ground before
every = 4

[craft]
mass_kg = 0.7  # a guess: the log does not say
"""


def crazyflie(data: Path) -> Record:
    """Return the diagnosis of the Crazyflie's flights; held out are those of some policies."""
    (learnt, model), (judged, _) = (flights(data / FOLDER, policies) for policies in (LEARNT, JUDGED))
    log = joined([learnt, judged])
    return diagnosed(log, model, np.arange(len(log)) >= len(learnt))[1]


def betaflight(data: Path) -> Record:
    """Return the diagnosis of the Betaflight log; held out are the last of every four blocks."""
    found = imported(data / BETAFLIGHT / "shortLog.BFL", "betaflight", QUAD)
    return diagnosed(found.log, found.nominal_model())[1]


DIAGNOSED_HEAD = """Learnt from are the flights of policies {learnt}; held out are those of policies {judged},
which command differently."""
MAPPED = """With this mapping:

```toml
{mapping}```"""
NO_RECORD = "Not on record; `python -m benchmarks.real_logs --diagnose {craft}` makes one."


class Craft(NamedTuple):
    """A drone: its title, the folder of its flights, how it is measured, and its part of the page.

    folder: within the folder of all data, which ``measure`` is given. part: of a record, what stands before
    its diagnoses; or a text. diagnoses: of a record, by title.
    """

    title: str
    folder: str
    measure: Callable[[Path], Record]
    part: Callable[[Record], str]
    diagnoses: Callable[[Record], dict[str, Record]] = lambda record: {"": record}


CRAFTS = {
    "crazyflie": Craft(
        "Crazyflie 2.1, flown by learned policies: one diagnosis",
        FOLDER,
        crazyflie,
        lambda record: DIAGNOSED_HEAD.format(learnt=", ".join(LEARNT), judged=", ".join(JUDGED)),
    ),
    "payload": Craft(
        "Crazyflie 2.1 with a payload on a cable",
        payload.STANDARD,
        payload.measure,
        payload.part,
        lambda record: {f"Pair: {name}": one for name, one in record.items()},
    ),
    "nanobench": Craft(
        "Crazyflie 2.1 in angle mode (NanoBench)",
        nanobench.FOLDER,
        nanobench.measure,
        nanobench.part,
        lambda record: {
            f"Held out: {', '.join(name.partition('_rep')[0] for name in one['by_flight'])}": one
            for one in record["folds"]
        },
    ),
    "gecko": Craft(
        "Betaflight quadcopter with 4S (Gecko), one acro flight",
        gecko.FOLDER,
        gecko.measure,
        lambda record: gecko.part(record) + "\n\n" + MAPPED.format(mapping=gecko.MAPPING),
    ),
    "betaflight": Craft(
        "Betaflight quadcopter with 6S, one acro flight",
        BETAFLIGHT,
        betaflight,
        lambda record: MAPPED.format(mapping=QUAD),
    ),
}


def kept(craft: str) -> Path:
    """Return the file that keeps a craft's record."""
    return LINES.with_name(f"{craft}_diagnosis.json")


def page() -> tuple[str, dict[str, bytes]]:
    """Return the page on what is on record, and its pictures by file."""
    head = (ROOT / "benchmarks" / "pages" / "real_logs.md").read_text(encoding="utf-8").strip()
    parts, pictures = [head, "## Crazyflie 2.1, flown by learned policies", crazyflie_part()], {}
    for name, craft in CRAFTS.items():
        parts.append(f"## {craft.title}")
        if not kept(name).exists():
            parts.append(NO_RECORD.format(craft=name))
            continue
        measured = json.loads(kept(name).read_text(encoding="utf-8"))
        parts.append(craft.part(measured))
        for number, (title, one) in enumerate(craft.diagnoses(measured).items()):
            file, figure = f"real_{name}_{number}.png", draw(one)
            parts += [f"### {title}" if title else "", section(one, file)]
            if figure is not None:
                pictures[file] = png_of(figure)
    return "\n\n".join(part for part in parts if part) + "\n", pictures


def main(data: Path = DATA, diagnose: str = "") -> None:
    """Diagnose, or write the page, or say why not."""
    for name in filter(None, diagnose.split(",")):
        folder = data / CRAFTS[name].folder
        if not folder.is_dir():
            sys.exit(f"skipped: no measured flights at {folder}; --data or {VARIABLE} names their folder")
        try:
            write_json(kept(name), CRAFTS[name].measure(data))
        except LogError as error:
            sys.exit(f"skipped: {error}")
    if not diagnose:
        text, pictures = page()
        for file, content in {RESULT.name: text.encode(), **pictures}.items():
            write_atomically(RESULT.with_name(file), content)
        print(f"written: {RESULT}, {', '.join(pictures)}")


if __name__ == "__main__":
    command(main)
