"""Drones whose measured flights are diagnosed: how each is measured, and its part of the page."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from benchmarks import report
from benchmarks.real.black_boxes import base_steps, flown, linear_ones, posed, rows_of
from benchmarks.real.crazyflie import AS_GOOD, FOLDER, MOST, SPACING_S, by_flight, flights
from benchmarks.real.section import Record, diagnose_log, import_mapped, test_model
from benchmarks.report import table
from flytrack_env.dynamics import ModelParameters, collective_thrust
from flytrack_sysid import FlightLog, import_log
from flytrack_sysid.diagnosis import joined
from flytrack_sysid.diagnosis.refinement import windows_of
from flytrack_sysid.log import usual_step
from flytrack_sysid.prediction_windows import HORIZONS_S, QUANTITIES, make_windows

BETAFLIGHT = "betaflight_acro_log"
# Every third policy, by its number, is for judging.
LEARNT = ("48", "49", "52", "53", "67", "68", "70", "71")
JUDGED = ("50", "66", "69")
QUAD, GECKO_MAPPING = (
    Path(__file__).with_name("mappings").joinpath(f"{name}.toml").read_text(encoding="utf-8")
    for name in ("betaflight", "gecko")
)
GECKO, GECKO_FILE = "bf_gecko", "btfl_002.bbl"
BEFORE_S, AFTER_S = 0.3, 0.1  # of the setpoints that the best linear law knows
RIDGE = 1e-6
HORIZON, TARGETS = "0.25", {"refitted_base": 0.8, "arx": 1.1}
NANOBENCH = "nanobench"
HALVES = (
    "B2_circle_fast_rep1 B3_figure8_fast_rep1 B5_helix_fast_rep1 B8_star_fast_rep1"
    " B9_trefoil_medium_rep12",
    "B10_lissajous_fast_rep1 B3_figure8_slow_rep1 B6_linear_ramp_rep2 B7_oval_fast_rep1"
    " B9_trefoil_fast_rep14",
)
SECONDS = 17.0  # of each flight: the shortest lasts 18 s
STANDARD, UPGRADED = "cf_lee_standard", "cf_lee_upgraded"
PAYLOAD_MAPPING = 'extends = "crazyflie_lee"\n\n[rows]\nevery = 2\n\n[craft]\nmass_kg = {mass_kg}\n'
# Whose logs are also diagnosed by the model that is imported with them; and what that is called.
OWN_MODEL, OWN_MODEL_RECORD = "between series", "logs 202 and 203, by the imported model"
WITHIN = 0.05
UNWANTED = ("linear_drag", "quadratic_drag", "rotor_drag", "wind")


def gecko(data: Path) -> Record:
    """Return the diagnosis of a Betaflight craft, and the errors of black boxes.

    The second half of the flight is held out.
    """
    found = import_mapped(data / GECKO / GECKO_FILE, "betaflight", GECKO_MAPPING)
    held_out = found.log.time > 0.5 * (found.log.time[0] + found.log.time[-1])
    diagnosis, record = diagnose_log(found.log, found.nominal_model(), held_out)
    log, base = posed(found.log), diagnosis.base._replace(effects=())
    with jax.enable_x64(True):
        windows = windows_of(found.log, held_out)
        assert windows is not None
        steps, boxes = base_steps(base, log), linear_ones(rows_of(log.select(~held_out), base))
        for name, answer in boxes.items():
            rates = flown(answer, windows, steps).rms()[0, :, QUANTITIES.index("rates")]
            by_horizon = dict(
                zip(map("{:g}".format, HORIZONS_S), rates.round(6).tolist(), strict=True)
            )
            record["diagnosis"]["prediction"]["errors"][name] = {"rates_rad_per_s": by_horizon}
    return record | {"best_linear_rad_per_s": best_linear(found.log, held_out)}


def best_linear(log: FlightLog, held_out: np.ndarray) -> float:
    """Return the held-out rms error of rates, rad/s, of a linear law that knows later setpoints.

    No linear model of whatever order that is driven by the setpoints can do better but by chance.
    """
    back, ahead = (round(one / float(np.median(usual_step(log)))) for one in (BEFORE_S, AFTER_S))
    rows = np.arange(back, len(log) - ahead)
    known = log["u"][rows[:, None] + np.arange(-back, ahead + 1), :3].reshape(len(rows), -1)
    known, is_judged = np.c_[known, np.ones(len(rows))], held_out[rows]
    damping = RIDGE * np.diag(np.square(known[~is_judged]).sum(axis=0) + 1e-9)
    inner = known[~is_judged].T @ known[~is_judged] + damping
    slopes = np.linalg.solve(inner, known[~is_judged].T @ log["w"][rows[~is_judged]])
    left = log["w"][rows[is_judged]] - known[is_judged] @ slopes
    return float(np.sqrt(np.square(left).sum(axis=1).mean()))


def gecko_part(record: Record) -> str:
    """Return the figures, and the errors of all models."""
    found = record["diagnosis"]["prediction"]["errors"]
    errors = {name: one["rates_rad_per_s"] for name, one in found.items()}
    degrees = {
        name: [f"{np.rad2deg(value):.3g}" for value in one.values()] for name, one in errors.items()
    }
    rows = [[name.replace("_", " "), *cells] for name, cells in degrees.items()]
    figures = []
    for name, target in TARGETS.items():
        ratio = errors["extended"][HORIZON] / errors[name][HORIZON]
        label = f"extended over {name.replace('_', ' ')} after {HORIZON} s"
        figures.append(report.Figure(label, f"at most {target:g}", f"{ratio:.2f}", 1))
    return report.filled(
        "real_gecko",
        figures=report.figures_table(figures),
        best_linear=np.rad2deg(record["best_linear_rad_per_s"]),
        errors=table(
            ["body rates, rms, deg/s, after", *(f"{one:g} s" for one in HORIZONS_S)], rows
        ),
        mapping=GECKO_MAPPING,
    )


def nanobench(data: Path) -> Record:
    """Return diagnoses of a Crazyflie in angle mode, under Vicon, with error ratios by flight.

    The ratios are of the extended model's errors over the base's.

    The ten flights are of eight kinds of trajectory. Two diagnoses, each learnt from one half of
    the flights and judged on the other, so that every flight is held out once.
    """
    names = " ".join(HALVES).split()
    found = import_log([data / NANOBENCH / f"{name}.csv.gz" for name in names], "csv", NANOBENCH)
    starts = found.log.time[found.log.is_start()]
    log = found.log.select(found.log.time - starts[found.log.segment] < SECONDS)
    model = found.nominal_model()
    folds = []
    for judged in HALVES:
        held_out = np.isin(log.segment, [names.index(name) for name in judged.split()])
        diagnosis, record = diagnose_log(log, model, held_out)
        with jax.enable_x64(True):
            windows = make_windows(log, held_out, SPACING_S, MOST)
            models = {"refitted_base": diagnosis.base, "extended": diagnosis.extended}
            results = {name: test_model(one, windows) for name, one in models.items()}
        ratios = by_flight(results, log.segment[windows.start])
        record["by_flight"] = {names[int(number)]: one for number, one in ratios.items()}
        folds.append(record)
    return {"folds": folds}


def nanobench_part(record: Record) -> str:
    """Return how each held-out flight is predicted."""
    rows, every = [], []
    for name, ratios in sorted(
        pair for fold in record["folds"] for pair in fold["by_flight"].items()
    ):
        cells = np.array(ratios)
        known = cells[cells > 0.0]
        every.append(known)
        half_s = cells[HORIZONS_S.index(0.5)]
        worse = f"{np.sum(known > AS_GOOD)} of {len(known)}"
        rows.append([name, *(f"{one:.2f}" for one in (*half_s, known.max())), worse])
    cells = np.concatenate(every)
    heads = [f"{quantity} after 0.5 s" for quantity in QUANTITIES]
    return report.filled(
        "real_nanobench",
        seconds=SECONDS,
        figures=report.figures_table(
            [
                report.Figure(
                    "cells of at most 1.00", "100 %", *report.share((cells <= AS_GOOD).tolist())
                ),
                report.Figure("median", "at most 1.00", f"{np.median(cells):.2f}", len(cells)),
                report.Figure("largest", "at most 1.00", f"{cells.max():.2f}", len(cells)),
            ]
        ),
        flights=table(
            ["held-out flight", *heads, "largest of all horizons", "cells above 1.00"], rows
        ),
    )


class Pair(NamedTuple):
    """Logs that a model is of and logs that it is diagnosed on, each with a stated mass, kg."""

    known: tuple[str, ...]
    known_kg: float
    judged: tuple[str, ...]
    judged_kg: float


PAIRS = {
    "between series": Pair(
        (f"{STANDARD}/log182", f"{STANDARD}/log183"),
        0.032,
        (f"{UPGRADED}/log202", f"{UPGRADED}/log203"),
        0.0419,
    ),
    "within one series": Pair((f"{STANDARD}/log182",), 0.037, (f"{STANDARD}/log183",), 0.032),
}


def payload_flights(
    data: Path, names: Sequence[str], mass_kg: float
) -> tuple[FlightLog, ModelParameters]:
    """Return logs as one, and the nominal model of a mass."""
    found = import_mapped(
        [data / name for name in names], "usd", PAYLOAD_MAPPING.format(mass_kg=mass_kg)
    )
    return found.log, found.nominal_model()


def in_proportion(model: ModelParameters, per_command: float) -> ModelParameters:
    """Return a model whose thrust is proportional to the command.

    The command is in N. A flight near hover does not show the curve of the thrust.

    per_command: specific force, m/s^2, of a command of one above the lowest.
    """
    slope = per_command * float(model.m)
    return model._replace(thrust_coeffs=np.array([slope, slope, 0.0, 0.0, 0.0, 0.0]))


def thrust_of(model: ModelParameters, log: FlightLog) -> float:
    """Return the mean thrust over the mass that a model gives to a log's commands, m/s^2."""
    stick = log["u"][:, 3]
    thrust = collective_thrust(
        stick, model.battery.voltage(0.5), np.asarray(model.thrust_coeffs, float)
    )
    return float(np.mean(thrust) * float(model.effect("thrust_scale").factor) / float(model.m))


def payload(data: Path) -> Record:
    """Return a record of each pair: a hidden payload, by a model of flights with another mass.

    Between series: the model of logs 182 and 183, on logs 202 and 203, which carry 5 g on a cable.
    Thrust commands of the two series do not compare (docs/real_logs.md), so there is a second pair
    within one series: the model of log 182, which carries a payload, on log 183, which does not.
    And logs 202 and 203 by the model that was imported with them, whose mass is right: what a load
    does beside its weight.
    """
    records = {}
    for name, pair in PAIRS.items():
        known, nominal = payload_flights(data, pair.known, pair.known_kg)
        judged, _ = payload_flights(data, pair.judged, pair.judged_kg)
        per_command = [
            np.median(log["f"][:, 2]) / np.median(log["u"][:, 3] + 1.0) for log in (known, judged)
        ]
        model, of_model = diagnose_log(known, in_proportion(nominal, per_command[0]))
        reference = in_proportion(model.extended, per_command[0])
        found, record = diagnose_log(judged, reference)
        records[name] = record | {
            "model": of_model["diagnosis"]["causes"],
            "ratio": thrust_of(found.extended, judged) / thrust_of(reference, judged),
            "force_per_command_ratio": float(per_command[1] / per_command[0]),
        }
    logs = payload_flights(data, PAIRS[OWN_MODEL].judged, PAIRS[OWN_MODEL].judged_kg)
    return records | {OWN_MODEL_RECORD: diagnose_log(*logs)[1]}


def payload_part(record: Record) -> str:
    """Return ratios found and true, and whether anything was named that is not there."""
    rows = []
    for name, pair in PAIRS.items():
        one, names = (
            record[name],
            [cause["effect"] for cause in record[name]["diagnosis"]["causes"]],
        )
        ratio, true_ratio = one["ratio"], pair.known_kg / pair.judged_kg  # of thrust over mass
        false = ", ".join(f"`{effect}`" for effect in names if effect in UNWANTED) or "none"
        logs = [
            " and ".join(path.rpartition("log")[2] for path in paths)
            for paths in (pair.known, pair.judged)
        ]
        found = [f"{ratio:.3f}", f"{true_ratio:.3f}", f"{ratio / true_ratio - 1.0:+.1%}"]
        is_named = "yes" if "thrust_scale" in names else "no"
        rows.append([name, *logs, *found, f"{one['force_per_command_ratio']:.3f}", is_named, false])
    header = (
        "pair | model of logs | diagnosed on | thrust over mass, found | by the stated masses | "
        f"off (target: {WITHIN:.0%}) | measured force per command | `thrust_scale` named | "
        "drag or wind named"
    )
    return table(header, rows)


def crazyflie(data: Path) -> Record:
    """Return the diagnosis of the Crazyflie's flights; held out are those of some policies."""
    (learnt, model), (judged, _) = (
        flights(data / FOLDER, policies) for policies in (LEARNT, JUDGED)
    )
    log = joined([learnt, judged])
    return diagnose_log(log, model, np.arange(len(log)) >= len(learnt))[1]


def betaflight(data: Path) -> Record:
    """Return the diagnosis of the Betaflight log; held out are the last of every four blocks."""
    found = import_mapped(data / BETAFLIGHT / "shortLog.BFL", "betaflight", QUAD)
    return diagnose_log(found.log, found.nominal_model())[1]


class Craft(NamedTuple):
    """A drone: its title, the folder of its flights, how it is measured, and its part of the page.

    folder: within the folder of all data, which ``measure`` is given. part: of a record, what
    stands before its diagnoses; or a text. diagnoses: of a record, by title.
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
        lambda record: report.filled(
            "real_learnt", learnt=", ".join(LEARNT), judged=", ".join(JUDGED)
        ),
    ),
    "payload": Craft(
        "Crazyflie 2.1 with a payload on a cable",
        STANDARD,
        payload,
        payload_part,
        lambda record: {
            f"Pair: {name}" if name in PAIRS else name: one for name, one in record.items()
        },
    ),
    "nanobench": Craft(
        "Crazyflie 2.1 in angle mode (NanoBench)",
        NANOBENCH,
        nanobench,
        nanobench_part,
        lambda record: {
            f"Held out: {', '.join(name.partition('_rep')[0] for name in one['by_flight'])}": one
            for one in record["folds"]
        },
    ),
    "gecko": Craft(
        "Betaflight quadcopter with 4S (Gecko), one acro flight", GECKO, gecko, gecko_part
    ),
    "betaflight": Craft(
        "Betaflight quadcopter with 6S, one acro flight",
        BETAFLIGHT,
        betaflight,
        lambda record: f"With this mapping:\n\n```toml\n{QUAD}```",
    ),
}
