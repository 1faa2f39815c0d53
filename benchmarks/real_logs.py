"""The diagnosis of measured flights of two drones.

``python -m benchmarks.real_logs [--data ../shared/data]`` writes docs/results/real_logs_diagnosis.md. Two
crafts: a Crazyflie 2.1 flown by learned policies (some policies are held out), and an acro flight of a
Betaflight quadcopter.
Where the data or the reader of Betaflight logs are absent, it says so and writes nothing.
"""

import argparse
import os
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import jax
import numpy as np

from benchmarks.report import RESULTS, ROOT, table
from flytrack_env.files import write_atomically
from flytrack_sysid import Diagnosis, FlightLog, LogError, diagnose, import_log
from flytrack_sysid.diagnosis import joined

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


class Craft(NamedTuple):
    """A craft's diagnosis, the number of rows of its log, and how long it took, CPU s."""

    found: Diagnosis
    num_rows: int
    cpu_s: float


def timed(log: FlightLog, model: object, held_out: np.ndarray | None) -> Craft:
    """Return a log's diagnosis."""
    started = time.process_time()
    found = diagnose(log, model, held_out)
    return Craft(found, len(log), time.process_time() - started)


def crazyflie(data: Path) -> Craft:
    """Return the diagnosis of the Crazyflie's flights; held out are those of some policies."""

    def imported(policies: Iterable[str]) -> tuple:
        files = [file for policy in policies for file in sorted(data.glob(f"seed000{policy}_*.csv.gz"))]
        found = import_log(files, "csv", "crazyflie_phoenix")
        return found.log, found.nominal_model()

    (learnt, model), (judged, _) = imported(LEARNT), imported(JUDGED)
    log = joined([learnt, judged])
    return timed(log, model, np.arange(len(log)) >= len(learnt))


def betaflight(data: Path) -> Craft:
    """Return the diagnosis of the Betaflight log; held out are the last of every four blocks."""
    with TemporaryDirectory() as folder:
        mapping = Path(folder) / "quad.toml"
        mapping.write_text(QUAD, encoding="utf-8")
        found = import_log(data / "shortLog.BFL", "betaflight", mapping)
    return timed(found.log, found.nominal_model(), None)


def number(value: float | None, unit: str = "1") -> str:
    """Return three digits, and the unit if there is one."""
    text = "none" if value is None or not np.isfinite(value) else f"{value:.3g}"
    return text if unit == "1" else f"{text} {unit}"


def causes_table(found: Diagnosis) -> str:
    """Return the causes with intervals, gains and what they may be confused with."""
    rows = []
    for cause in found.causes:
        values = "<br>".join(
            f"{name} {number(one.value, one.unit)} ({' to '.join(map(number, one.ci95))})"
            for name, one in cause.parameters.items()
        )
        against = f"no (closest: {cause.closest})" if cause.closest else "not tried"
        gains = (cause.chi2_gain, cause.heldout_gain, cause.lambda_, cause.lambda_sep)
        alike = ", ".join(cause.equivalent) or against
        rows.append([f"`{cause.effect}`", values, *map(number, gains), alike])
    header = "cause | values, 95 % intervals | chi2_gain | heldout_gain | lambda | lambda_sep | alike?"
    return table(header, rows)


def errors_table(found: Diagnosis) -> str:
    """Return the errors of the models on held-out rows."""
    models = list(found.error.values())
    rows = [
        [f"{name}, one step, NRMSE", *(number(one.one_step_nrmse[name]) for one in models)]
        for name in models[0].one_step_nrmse
    ]
    rows += [
        [f"position after {name} s, m", *(number(one.position_m[name]) for one in models)]
        for name in models[0].position_m
    ]
    return table(["error on held-out rows", *(name.replace("_", " ") for name in found.error)], rows)


def unseen_table(found: Diagnosis) -> str:
    """Return what the log could not have shown."""
    rows = [
        [f"`{one.effect}`", number(one.smallest, one.unit), ", ".join(one.confused_with) or "noise"]
        for one in found.not_identifiable
    ]
    return table("effect | seen for sure from | looks like", rows)


def section(craft: Craft) -> str:
    """Return what was found on one craft."""
    found, left = craft.found, craft.found.unexplained
    shares = ", ".join(
        f"{name} ({number(share)} times the sensor's noise)" for name, share in left.shares.items()
    )
    parts = [
        f"{craft.num_rows} rows; verdict `{found.verdict}`; {craft.cpu_s:.0f} CPU s, compilation included.",
        causes_table(found),
        errors_table(found),
        f"Unexplained: {shares or 'nothing'}.",
        *found.warnings,
        "What this log could not have shown:",
        unseen_table(found),
    ]
    return "\n\n".join(parts)


HEAD = """# The diagnosis on measured flights

Written by `python -m benchmarks.real_logs`; do not edit. The flights were measured by others and are not part
of this repository: they are read from `../shared/data`, or the folder that `FLYTRACK_SHARED_DATA` names
([real logs](../real_logs.md)). How to read this page: [the diagnosis](../diagnosis.md); how far to trust
it: [real logs](../real_logs.md#diagnoses-of-these-logs). jax {jax}."""

CRAZYFLIE_HEAD = """## Crazyflie 2.1, flown by learned policies

Learnt from are the flights of policies {learnt}; held out are those of policies {judged}, which command
differently."""

BETAFLIGHT_HEAD = """## Betaflight quadcopter, one acro flight

With this mapping, `quad.toml`:

```toml
{quad}```"""


def page(flown: Craft, acro: Craft) -> str:
    """Return the page on both crafts."""
    parts = [
        HEAD.format(jax=jax.__version__),
        CRAZYFLIE_HEAD.format(learnt=", ".join(LEARNT), judged=", ".join(JUDGED)),
        section(flown),
        BETAFLIGHT_HEAD.format(quad=QUAD),
        section(acro),
    ]
    return "\n\n".join(parts) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the page, or say why not."""
    parser = argparse.ArgumentParser(description=__doc__)
    default = os.environ.get(VARIABLE, ROOT.parent / "shared" / "data")
    parser.add_argument("--data", type=Path, default=default, help="default: %(default)s")
    data = Path(parser.parse_args(arguments).data)
    for folder in (CRAZYFLIE, BETAFLIGHT):
        if not (data / folder).is_dir():
            sys.exit(
                f"skipped: no measured flights at {data / folder}; --data or {VARIABLE} names their folder"
            )
    try:
        acro = betaflight(data / BETAFLIGHT)
    except LogError as error:
        sys.exit(f"skipped: {error}")
    write_atomically(RESULT, page(crazyflie(data / CRAZYFLIE), acro).encode())
    print(f"written: {RESULT}")


if __name__ == "__main__":
    main()
