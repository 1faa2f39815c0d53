"""A hidden payload: models of a Crazyflie's earlier flights are diagnosed on flights with another mass.

As asked: the model of logs 182 and 183, on logs 202 and 203, which carry 5 g on a cable. Thrust commands of
the two series do not compare (docs/real_logs.md), so there is a second pair within one series: the model of
log 182, which carries a payload, on log 183, which does not.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.real.section import Record, diagnosed, imported
from benchmarks.report import table
from flytrack_env.dynamics import ModelParameters, collective_thrust
from flytrack_sysid import FlightLog
from flytrack_sysid.record import BATTERY_UNKNOWN_V

STANDARD, UPGRADED = "cf_lee_standard", "cf_lee_upgraded"
MAPPING = 'extends = "crazyflie_lee"\n\n[rows]\nevery = 2\n\n[craft]\nmass_kg = {mass_kg}\n'
WITHIN = 0.05
UNWANTED = ("linear_drag", "quadratic_drag", "rotor_drag", "wind")


class Pair(NamedTuple):
    """Logs that a model is of, with the mass it states, kg, and logs that it is diagnosed on, with theirs."""

    known: tuple[str, ...]
    known_kg: float
    judged: tuple[str, ...]
    judged_kg: float

    @property
    def true_ratio(self) -> float:
        """Thrust over mass on the logs that are judged, over that of the model."""
        return self.known_kg / self.judged_kg


PAIRS = {
    "asked": Pair(
        (f"{STANDARD}/log182", f"{STANDARD}/log183"),
        0.032,
        (f"{UPGRADED}/log202", f"{UPGRADED}/log203"),
        0.0419,
    ),
    "within one series": Pair((f"{STANDARD}/log182",), 0.037, (f"{STANDARD}/log183",), 0.032),
}


def flights(data: Path, names: Sequence[str], mass_kg: float) -> tuple[FlightLog, ModelParameters]:
    """Return logs as one, and the nominal model of a mass."""
    found = imported([data / name for name in names], "usd", MAPPING.format(mass_kg=mass_kg))
    return found.log, found.nominal_model()


def in_proportion(model: ModelParameters, per_command: float) -> ModelParameters:
    """Return a model whose thrust is in proportion to the command, which is in N: hover shows no curve.

    per_command: specific force, m/s^2, of a command of one above the lowest.
    """
    slope = per_command * float(model.m)
    return model._replace(thrust_coeffs=np.array([slope, slope, 0.0, 0.0, 0.0, 0.0]))


def thrust_of(model: ModelParameters, log: FlightLog) -> float:
    """Return the mean thrust over the mass that a model gives to a log's commands, m/s^2."""
    stick = log["u"][:, 3]
    thrust = collective_thrust(stick, BATTERY_UNKNOWN_V, np.asarray(model.thrust_coeffs, float))
    return float(np.mean(thrust) * float(model.effect("thrust_scale").factor) / float(model.m))


def measure(data: Path) -> Record:
    """Return a record of each pair."""
    records = {}
    for name, pair in PAIRS.items():
        known, nominal = flights(data, pair.known, pair.known_kg)
        judged, _ = flights(data, pair.judged, pair.judged_kg)
        per_command = [np.median(log["f"][:, 2]) / np.median(log["u"][:, 3] + 1.0) for log in (known, judged)]
        model, of_model = diagnosed(known, in_proportion(nominal, per_command[0]))
        reference = in_proportion(model.extended, per_command[0])
        found, record = diagnosed(judged, reference)
        records[name] = record | {
            "model": of_model["diagnosis"]["causes"],
            "ratio": thrust_of(found.extended, judged) / thrust_of(reference, judged),
            "force_per_command_ratio": float(per_command[1] / per_command[0]),
        }
    return records


def part(record: Record) -> str:
    """Return ratios found and true, and whether anything was named that is not there."""
    rows = []
    for name, pair in PAIRS.items():
        one, names = record[name], [cause["effect"] for cause in record[name]["diagnosis"]["causes"]]
        ratio, off = one["ratio"], one["ratio"] / pair.true_ratio - 1.0
        false = ", ".join(f"`{effect}`" for effect in names if effect in UNWANTED) or "none"
        logs = [
            " and ".join(path.rpartition("log")[2] for path in paths) for paths in (pair.known, pair.judged)
        ]
        found = [f"{ratio:.3f}", f"{pair.true_ratio:.3f}", f"{off:+.1%}"]
        is_named = "yes" if "thrust_scale" in names else "no"
        rows.append([name, *logs, *found, f"{one['force_per_command_ratio']:.3f}", is_named, false])
    header = (
        "pair | model of logs | diagnosed on | thrust over mass, found | by the stated masses | "
        f"off (asked: {WITHIN:.0%}) | measured force per command | `thrust_scale` named | drag or wind named"
    )
    return table(header, rows)
