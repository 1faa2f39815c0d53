"""Whether a change altered the diagnosis: 60 hidden plants whose names and intervals are recorded.

The plants of each row move in the three ways of ``benchmarks.hidden`` in turn.

``make check-diagnosis`` diagnoses them again and lists every difference: verdict, names, equivalence classes
and what is unexplained must stay, values and intervals agree to 1e-6. ``--rows one,clean --plants 2`` checks
a few. A change that means to alter results records them with ``--record``, and its message says why.
"""

import argparse
import json
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from datetime import date
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from benchmarks.diagnosis import Trial, make_log
from benchmarks.hidden import MOTIONS
from benchmarks.report import commit_of_checkout
from flytrack_env.files import write_atomically
from flytrack_sysid.diagnosis import Diagnosis, diagnose

RECORD = Path(__file__).parent.parent / "docs" / "results" / "diagnosis_check.json"
SEED = 2
STRATA = {
    "clean": 4, "heavy": 4, "coloured": 4, "gusts": 4, "one": 14, "two": 12, "three": 8, "outside": 10
}  # fmt: skip
TOLERANCE = 1e-6  # relative, and absolute below 1


def summarize(found: Diagnosis) -> dict[str, Any]:
    """Return what must stay: verdict, names, equivalence classes, what is unexplained; and all intervals."""
    return {
        "verdict": found.verdict,
        "causes": {
            cause.effect: {
                "equivalent": list(cause.equivalent),
                "intervals": {name: [one.value, *one.ci95] for name, one in cause.parameters.items()},
            }
            for cause in found.causes
        },
        "beyond_the_list": sorted(cause.effect for cause in found.beyond),
        "unexplained": sorted(found.unexplained.depends_on),
        "not_identifiable": sorted(one.effect for one in found.not_identifiable),
    }


def check_plant(case: tuple[str, int]) -> dict[str, Any]:
    """Diagnose one plant of a row."""
    row, number = case
    _, _, log, model, _ = make_log(Trial(row, number, SEED, MOTIONS[number % len(MOTIONS)]))
    return summarize(diagnose(log, model))


def differences(found: Any, recorded: Any, where: str) -> list[str]:
    """Return, leaf by leaf, where two summaries differ."""
    if isinstance(found, dict) and isinstance(recorded, dict) and found.keys() == recorded.keys():
        return [line for key in found for line in differences(found[key], recorded[key], f"{where} {key}")]
    are_numbers = isinstance(found, list) and found and isinstance(found[0], float)
    if are_numbers and np.shape(found) == np.shape(recorded):
        same = np.allclose(found, recorded, rtol=TOLERANCE, atol=TOLERANCE)
    else:
        same = found == recorded
    return [] if same else [f"{where}: found {found}, recorded {recorded}"]


def run_cases(cases: list[tuple[str, int]]) -> dict[str, dict[str, Any]]:
    """Return the summary of every plant, on all cores."""
    context = multiprocessing.get_context("spawn")  # JAX does not survive a fork
    with ProcessPoolExecutor(os.cpu_count(), mp_context=context) as pool:
        found = tqdm(pool.map(check_plant, cases), total=len(cases), unit=" plants", disable=None)
        return {f"{row} {number}": one for (row, number), one in zip(cases, found, strict=True)}


def main() -> None:
    """Check the diagnosis against its record, or make the record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--record", action="store_true", help="record all plants instead of checking them")
    parser.add_argument("--rows", default=",".join(STRATA), help="default: all")
    parser.add_argument("--plants", type=int, default=max(STRATA.values()), help="at most, of each row")
    arguments = parser.parse_args()
    if arguments.record:
        cases = [(row, number) for row in STRATA for number in range(STRATA[row])]
        stamp = {"commit": commit_of_checkout(), "date": str(date.today()), "jax": jax.__version__}
        record = {**stamp, "seed": SEED, "plants": run_cases(cases)}
        write_atomically(RECORD, json.dumps(record, indent=1).encode())
        print(f"{len(cases)} plants recorded in {RECORD}")
        return
    rows = arguments.rows.split(",")
    found = run_cases([(row, n) for row in rows for n in range(min(STRATA[row], arguments.plants))])
    record = json.loads(RECORD.read_text())
    lines = [line for name in found for line in differences(found[name], record["plants"][name], name)]
    print("\n".join(lines))
    print(f"{len(found)} plants, {len(lines)} differences from {RECORD.name} (commit {record['commit']})")
    sys.exit(bool(lines))


if __name__ == "__main__":
    main()
