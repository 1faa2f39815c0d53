"""The diagnosis of measured flights of two drones, and models judged on policies left out.

``python -m benchmarks.real_logs --diagnose crazyflie,betaflight [--data ../shared/data]`` diagnoses flights
and keeps the records in benchmarks/data/real; without ``--diagnose``, docs/results/real_logs_diagnosis.md is
written from the records there and from those of ``python -m benchmarks.real.crazyflie``. Two crafts: a
Crazyflie 2.1 flown by learned policies (some policies are held out), and an acro flight of a Betaflight
quadcopter. Where the data or the reader of Betaflight logs are absent, it says so and writes nothing.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import numpy as np

from benchmarks.real.crazyflie import LINES
from benchmarks.real.page import crazyflie_part
from benchmarks.report import RESULTS, ROOT, commit_of_checkout, table, write_json
from flytrack_env.dynamics import ModelParameters
from flytrack_env.files import write_atomically
from flytrack_sysid import FlightLog, LogError, diagnose, import_log
from flytrack_sysid.diagnosis import joined

Record = dict[str, Any]
RESULT = RESULTS / "real_logs_diagnosis.md"
VARIABLE = "FLYTRACK_SHARED_DATA"
CRAZYFLIE, BETAFLIGHT = "crazyflie_rate_flights", "betaflight_acro_log"
# Every third policy, by its number, is for judging.
LEARNT = ("48", "49", "52", "53", "67", "68", "70", "71")
JUDGED = ("50", "66", "69")
QUAD = """[rows]
from_s = 2.0  # it stands on the ground before
every = 4

[craft]
mass_kg = 0.7  # a guess: the log does not say
"""


def record(log: FlightLog, model: ModelParameters, held_out: np.ndarray | None) -> Record:
    """Return a log's diagnosis as JSON values, with the number of rows and the CPU time that it took."""
    started = time.process_time()
    found = diagnose(log, model, held_out)
    return {
        "num_rows": len(log),
        "cpu_s": time.process_time() - started,
        "jax": jax.__version__,
        "commit": commit_of_checkout(),
        "diagnosis": found.as_json(),
    }


def crazyflie(data: Path) -> Record:
    """Return the diagnosis of the Crazyflie's flights; held out are those of some policies."""

    def imported(policies: Iterable[str]) -> tuple:
        files = [file for policy in policies for file in sorted(data.glob(f"seed000{policy}_*.csv.gz"))]
        found = import_log(files, "csv", "crazyflie_phoenix")
        return found.log, found.nominal_model()

    (learnt, model), (judged, _) = imported(LEARNT), imported(JUDGED)
    log = joined([learnt, judged])
    return record(log, model, np.arange(len(log)) >= len(learnt))


def betaflight(data: Path) -> Record:
    """Return the diagnosis of the Betaflight log; held out are the last of every four blocks."""
    with TemporaryDirectory() as folder:
        mapping = Path(folder) / "quad.toml"
        mapping.write_text(QUAD, encoding="utf-8")
        found = import_log(data / "shortLog.BFL", "betaflight", mapping)
    return record(found.log, found.nominal_model(), None)


def number(value: float | None, unit: str = "1") -> str:
    """Return three digits, and the unit if there is one."""
    text = "none" if value is None or not np.isfinite(value) else f"{value:.3g}"
    return text if unit == "1" else f"{text} {unit}"


def causes_table(found: Record) -> str:
    """Return the causes with intervals, gains and what they may be confused with."""
    rows = []
    for cause in found["causes"]:
        values = "<br>".join(
            f"{name} {number(one['value'], one['unit'])} ({' to '.join(map(number, one['ci95']))})"
            for name, one in cause["parameters"].items()
        )
        values += f"<br>**beyond the list: {cause['beyond']}**" if cause["beyond"] else ""
        rival = cause["closest_rival"]
        against = f"no (closest: {rival})" if rival else "not tried"
        gains = (cause["chi2_gain"], cause["heldout_gain"], cause["lambda"], cause["lambda_sep"])
        alike = ", ".join(cause["equivalent"]) or against
        rows.append([f"`{cause['effect']}`", values, *map(number, gains), alike])
    header = "cause | values, 95 % intervals | chi2_gain | heldout_gain | lambda | lambda_sep | alike?"
    return table(header, rows)


def errors_table(found: Record) -> str:
    """Return the errors of the models on held-out rows, of one step and of free flight."""
    models, flights = found["error"], found["prediction"]["errors"]
    columns = [*models, *(name for name in flights if name not in models)]
    rows = [
        [f"{channel}, one step, NRMSE"]
        + [number(models.get(name, {}).get("one_step_nrmse", {}).get(channel)) for name in columns]
        for channel in models["nominal"]["one_step_nrmse"]
    ]
    for quantity, by_horizon in flights.get("nominal", {}).items():
        what, unit = quantity.split("_", 1)
        rows += [
            [f"{what} after {horizon} s, {unit.replace('_per_', '/')}"]
            + [number(flights.get(name, {}).get(quantity, {}).get(horizon)) for name in columns]
            for horizon in by_horizon
        ]
    return table(["rms error on held-out rows", *(name.replace("_", " ") for name in columns)], rows)


def changed_table(found: Record) -> str:
    """Return every parameter of the extended model that is not nominal."""
    rows = [
        [
            f"`{one['name']}`",
            number(one["nominal"], one["unit"]),
            number(one["value"], one["unit"]) + (" (end of what is searched)" if one["is_at_bound"] else ""),
            " to ".join(map(number, one["ci95"])),
        ]
        for one in found["changed"]
    ]
    return table("parameter | nominal | extended | 95 % interval", rows)


def unseen_table(found: Record) -> str:
    """Return what the log could not have shown."""
    rows = [
        [
            f"`{one['effect']}`",
            number(one["smallest_detectable"]["value"], one["smallest_detectable"]["unit"]),
            ", ".join(one["confused_with"]) or "noise",
        ]
        for one in found["not_identifiable"]
    ]
    return table("effect | seen for sure from | looks like", rows)


def section(measured: Record) -> str:
    """Return what was found on one craft."""
    found = measured["diagnosis"]
    left = found["unexplained"]["times_sensor_noise"]
    shares = ", ".join(f"{name} ({number(share)} times the sensor's noise)" for name, share in left.items())
    cost = f"{measured['cpu_s']:.0f} CPU s, compilation included; commit {measured['commit']}"
    parts = [
        f"{measured['num_rows']} rows; verdict `{found['verdict']}`; {cost}.",
        causes_table(found),
        errors_table(found),
        "Every parameter that changed:",
        changed_table(found),
        f"Unexplained: {shares or 'nothing'}.",
        *found["warnings"],
        "What this log could not have shown:",
        unseen_table(found),
    ]
    return "\n\n".join(parts)


HEAD = """# The diagnosis on measured flights

Written by `python -m benchmarks.real_logs` from the records in `benchmarks/data/real`; do not edit. The
flights were measured by others and are not part of this repository: they are read from `../shared/data`, or
the folder that `FLYTRACK_SHARED_DATA` names ([real logs](../real_logs.md)). How to read this page:
[the diagnosis](../diagnosis.md); how far to trust it:
[real logs](../real_logs.md#diagnoses-of-these-logs)."""

CRAZYFLIE_HEAD = "## Crazyflie 2.1, flown by learned policies"

DIAGNOSED_HEAD = """### One diagnosis

Learnt from are the flights of policies {learnt}; held out are those of policies {judged}, which command
differently."""

BETAFLIGHT_HEAD = """## Betaflight quadcopter, one acro flight

With this mapping, `quad.toml`:

```toml
{quad}```"""


NO_RECORD = "Not on record; `python -m benchmarks.real_logs --diagnose {craft}` makes one."


def kept(craft: str) -> Path:
    """Return the file that keeps a craft's record."""
    return LINES.with_name(f"{craft}_diagnosis.json")


def page() -> str:
    """Return the page on what is on record."""
    records = {
        craft: json.loads(kept(craft).read_text(encoding="utf-8")) for craft in CRAFTS if kept(craft).exists()
    }
    parts = [HEAD, CRAZYFLIE_HEAD, crazyflie_part()]
    heads = {
        "crazyflie": DIAGNOSED_HEAD.format(learnt=", ".join(LEARNT), judged=", ".join(JUDGED)),
        "betaflight": BETAFLIGHT_HEAD.format(quad=QUAD),
    }
    for craft, head in heads.items():
        parts += [head, section(records[craft]) if craft in records else NO_RECORD.format(craft=craft)]
    return "\n\n".join(part for part in parts if part) + "\n"


CRAFTS = {"crazyflie": (CRAZYFLIE, crazyflie), "betaflight": (BETAFLIGHT, betaflight)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Diagnose, or write the page, or say why not."""
    parser = argparse.ArgumentParser(description=__doc__)
    default = os.environ.get(VARIABLE, ROOT.parent / "shared" / "data")
    parser.add_argument("--data", type=Path, default=default, help="default: %(default)s")
    parser.add_argument("--diagnose", default="", help=f"of {', '.join(CRAFTS)}")
    chosen = parser.parse_args(arguments)
    for craft in filter(None, chosen.diagnose.split(",")):
        folder, measure = Path(chosen.data) / CRAFTS[craft][0], CRAFTS[craft][1]
        if not folder.is_dir():
            sys.exit(f"skipped: no measured flights at {folder}; --data or {VARIABLE} names their folder")
        try:
            write_json(kept(craft), measure(folder))
        except LogError as error:
            sys.exit(f"skipped: {error}")
    if not chosen.diagnose:
        write_atomically(RESULT, page().encode())
        print(f"written: {RESULT}")


if __name__ == "__main__":
    main()
