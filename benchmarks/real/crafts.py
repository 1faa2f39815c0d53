"""Drones whose measured flights are diagnosed: how each is measured, and its part of the page."""

from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import jax
import numpy as np

from benchmarks import report
from benchmarks.real.black_boxes import (
    base_steps,
    fit_linear_boxes,
    fit_ridge,
    fly_windows,
    rows_of,
    with_pose,
)
from benchmarks.real.crazyflie import (
    AS_GOOD,
    FOLDER,
    MAX_WINDOWS,
    SPACING_S,
    error_ratios,
    load_flights,
)
from benchmarks.real.section import Record, diagnose_log
from benchmarks.report import table
from flytrack_env.dynamics import ModelParameters, collective_thrust
from flytrack_sysid import FlightLog, import_log
from flytrack_sysid.diagnosis import joined
from flytrack_sysid.diagnosis.flight_errors import FlightErrors, sample_windows
from flytrack_sysid.inference.free_flight import (
    HORIZONS_S,
    QUANTITIES,
    evaluate_windows,
    make_windows,
)
from flytrack_sysid.log import median_step

BETAFLIGHT = "betaflight_acro_log"
# Every third policy, by its number, is for judging.
TRAINING = ("48", "49", "52", "53", "67", "68", "70", "71")
HELD_OUT = ("50", "66", "69")
MAPPINGS = Path(__file__).with_name("mappings")
QUAD, GECKO_MAPPING = MAPPINGS / "betaflight.toml", MAPPINGS / "gecko.toml"
GECKO, GECKO_FILE = "bf_gecko", "btfl_002.bbl"
BEFORE_S, AFTER_S = 0.3, 0.1  # of the setpoints that the best linear law knows
HORIZON, TARGETS = "0.25", {"refitted_base": 0.8, "arx": 1.1}
SHOWN_S = (HORIZON, "1")
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
IMPORTED_MODEL, IMPORTED_MODEL_RECORD = (
    "between series",
    "logs 202 and 203, by the imported model",
)
WITHIN = 0.05
UNWANTED = ("linear_drag", "quadratic_drag", "rotor_drag", "wind")


def gecko(data: Path) -> Record:
    """Return the diagnosis of a Betaflight craft, and the errors of black boxes.

    The second half of the flight is held out.
    """
    flight = import_log(data / GECKO / GECKO_FILE, "betaflight", GECKO_MAPPING)
    log = flight.log
    held_out = log.time > 0.5 * (log.time[0] + log.time[-1])
    diagnosis, record = diagnose_log(log, flight.nominal_model(), held_out)
    base, posed = diagnosis.base._replace(effects=()), with_pose(log)
    with jax.enable_x64(True):
        windows = sample_windows(log, held_out)
        assert windows is not None
        steps, rows = base_steps(base, posed), rows_of(posed.select(~held_out), base)
        for name, black_box in fit_linear_boxes(rows).items():
            rms = fly_windows(black_box, windows, steps).rms()[0, :, QUANTITIES.index("rates")]
            horizons = [f"{horizon:g}" for horizon in HORIZONS_S]
            by_horizon = dict(zip(horizons, rms.round(6).tolist(), strict=True))
            record["diagnosis"]["prediction"]["errors"][name] = {"rates_rad_per_s": by_horizon}
    return record | {"best_linear_rad_per_s": best_linear(log, held_out)}


def best_linear(log: FlightLog, held_out: np.ndarray) -> float:
    """Return the held-out rms error of rates, rad/s, of a linear law that knows later setpoints.

    No linear model of whatever order that is driven by the setpoints can do better but by chance.
    """
    step_s = median_step(log)
    back, ahead = round(BEFORE_S / step_s), round(AFTER_S / step_s)
    rows = np.arange(back, len(log) - ahead)
    setpoints = log["u"][rows[:, None] + np.arange(-back, ahead + 1), :3].reshape(len(rows), -1)
    rates, is_held_out = log["w"][rows], held_out[rows]
    law = fit_ridge(setpoints[~is_held_out], rates[~is_held_out])
    residuals = (rates - law(setpoints))[is_held_out]
    return float(np.sqrt(np.square(residuals).sum(axis=1).mean()))


def gecko_part(record: Record) -> str:
    """Return the figures, and the errors of all models."""
    by_model = record["diagnosis"]["prediction"]["errors"]
    rates = {name: errors["rates_rad_per_s"] for name, errors in by_model.items()}
    rows = [
        [name.replace("_", " "), *(f"{np.rad2deg(errors[key]):.3g}" for key in SHOWN_S)]
        for name, errors in rates.items()
    ]
    figures = []
    for name, target in TARGETS.items():
        ratio = rates["extended"][HORIZON] / rates[name][HORIZON]
        label = f"extended over {name.replace('_', ' ')} after {HORIZON} s"
        figures.append(report.Figure(label, f"at most {target:g}", f"{ratio:.2f}", 1))
    heads = ["body rates, rms, deg/s, after", *(f"{key} s" for key in SHOWN_S)]
    return report.filled(
        "real_gecko",
        figures=report.figures_table(figures),
        best_linear=np.rad2deg(record["best_linear_rad_per_s"]),
        errors=table(heads, rows),
        mapping=GECKO_MAPPING.read_text(encoding="utf-8"),
    )


def nanobench_flights(
    data: Path, names: Sequence[str], mapping: str
) -> tuple[FlightLog, ModelParameters]:
    """Return flights of NanoBench as one log, of the same length each, and the nominal model."""
    files = [data / NANOBENCH / f"{name}.csv.gz" for name in names]
    flight = import_log(files, "csv", mapping)
    starts_s = flight.log.time[flight.log.is_start()]
    log = flight.log.select(flight.log.time - starts_s[flight.log.segment] < SECONDS)
    return log, flight.nominal_model()


def nanobench(data: Path) -> Record:
    """Return diagnoses of a Crazyflie in angle mode, under Vicon, with error ratios by flight.

    The ratios are of the extended model's errors over the base's.

    The ten flights are of eight kinds of trajectory. Two diagnoses, each learnt from one half of
    the flights and judged on the other, so that every flight is held out once.
    """
    names = " ".join(HALVES).split()
    log, nominal = nanobench_flights(data, names, NANOBENCH)
    folds = []
    for half in HALVES:
        held_out = np.isin(log.segment, [names.index(name) for name in half.split()])
        diagnosis, record = diagnose_log(log, nominal, held_out)
        with jax.enable_x64(True):
            windows = make_windows(log, held_out, SPACING_S, MAX_WINDOWS)
            base, extended = (
                FlightErrors(evaluate_windows(model, windows)[None], windows)
                for model in (diagnosis.base, diagnosis.extended)
            )
        ratios = error_ratios(base, extended, log.segment[windows.start])
        record["by_flight"] = {names[int(number)]: cells for number, cells in ratios.items()}
        folds.append(record)
    return {"folds": folds}


def nanobench_part(record: Record) -> str:
    """Return how the held-out flights are predicted."""
    by_flight = [ratios for fold in record["folds"] for ratios in fold["by_flight"].values()]
    shown = np.array([ratios[HORIZONS_S.index(0.5)] for ratios in by_flight])
    cells = np.concatenate([np.ravel(ratios) for ratios in by_flight])
    cells = cells[cells > 0.0]
    figures = [
        report.share_figure("cells of at most 1.00", "100 %", (cells <= AS_GOOD).tolist()),
        report.Figure("median", "at most 1.00", f"{np.median(cells):.2f}", len(cells)),
        report.Figure("largest", "at most 1.00", f"{cells.max():.2f}", len(cells)),
        *(
            report.Figure(
                f"{quantity} after 0.5 s, lowest to highest",
                "",
                report.spread(values.tolist(), ".2f"),
                len(values),
            )
            for quantity, values in zip(QUANTITIES, shown.T, strict=True)
        ),
    ]
    return report.filled("real_nanobench", seconds=SECONDS, figures=report.figures_table(figures))


class Pair(NamedTuple):
    """Logs that a model is of and logs that it is diagnosed on, each with a stated mass, kg."""

    reference: tuple[str, ...]
    reference_kg: float
    diagnosed: tuple[str, ...]
    diagnosed_kg: float


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
    with TemporaryDirectory() as folder:
        mapping = Path(folder) / "mapping.toml"
        mapping.write_text(PAYLOAD_MAPPING.format(mass_kg=mass_kg), encoding="utf-8")
        flight = import_log([data / name for name in names], "usd", mapping)
    return flight.log, flight.nominal_model()


def in_proportion(model: ModelParameters, per_command: float) -> ModelParameters:
    """Return a model whose thrust is proportional to the command.

    The command is in N. A flight near hover does not show the curve of the thrust.

    Args:
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
        known, nominal = payload_flights(data, pair.reference, pair.reference_kg)
        log, _ = payload_flights(data, pair.diagnosed, pair.diagnosed_kg)
        known_force, force = (
            np.median(one["f"][:, 2]) / np.median(one["u"][:, 3] + 1.0) for one in (known, log)
        )
        earlier, earlier_record = diagnose_log(known, in_proportion(nominal, known_force))
        reference = in_proportion(earlier.extended, known_force)
        diagnosis, record = diagnose_log(log, reference)
        records[name] = record | {
            "model": earlier_record["diagnosis"]["causes"],
            "ratio": thrust_of(diagnosis.extended, log) / thrust_of(reference, log),
            "force_per_command_ratio": float(force / known_force),
        }
    pair = PAIRS[IMPORTED_MODEL]
    log, model = payload_flights(data, pair.diagnosed, pair.diagnosed_kg)
    return records | {IMPORTED_MODEL_RECORD: diagnose_log(log, model)[1]}


def payload_part(record: Record) -> str:
    """Return ratios found and true, and whether anything was named that is not there."""
    rows = []
    for name, pair in PAIRS.items():
        measured = record[name]
        causes = [cause["effect"] for cause in measured["diagnosis"]["causes"]]
        ratio = measured["ratio"]
        true_ratio = pair.reference_kg / pair.diagnosed_kg  # of thrust over mass
        logs = [
            " and ".join(path.rpartition("log")[2] for path in paths)
            for paths in (pair.reference, pair.diagnosed)
        ]
        rows.append(
            [
                name,
                *logs,
                f"{ratio:.3f}",
                f"{true_ratio:.3f}",
                f"{ratio / true_ratio - 1.0:+.1%}",
                f"{measured['force_per_command_ratio']:.3f}",
                "yes" if "thrust_scale" in causes else "no",
                ", ".join(f"`{effect}`" for effect in causes if effect in UNWANTED) or "none",
            ]
        )
    header = (
        "pair | model of logs | diagnosed on | thrust over mass, found | by the stated masses | "
        f"off (target: {WITHIN:.0%}) | measured force per command | `thrust_scale` named | "
        "drag or wind named"
    )
    return table(header, rows)


def crazyflie(data: Path) -> Record:
    """Return the diagnosis of the Crazyflie's flights; held out are those of some policies."""
    training, model = load_flights(data / FOLDER, TRAINING)
    log = joined([training, load_flights(data / FOLDER, HELD_OUT)[0]])
    return diagnose_log(log, model, np.arange(len(log)) >= len(training))[1]


def betaflight(data: Path) -> Record:
    """Return the diagnosis of the Betaflight log; held out are the last of every four blocks."""
    flight = import_log(data / BETAFLIGHT / "shortLog.BFL", "betaflight", QUAD)
    return diagnose_log(flight.log, flight.nominal_model())[1]


class Craft(NamedTuple):
    """A drone: its title, the folder of its flights, how it is measured, and its part of the page.

    Attributes:
        folder: within the folder of all data, which ``measure`` is given.
        part: of a record, what stands before its diagnoses; or a text.
        diagnoses: of a record, by title.
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
            "real_learnt", learnt=", ".join(TRAINING), judged=", ".join(HELD_OUT)
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
        lambda record: f"With this mapping:\n\n```toml\n{QUAD.read_text(encoding='utf-8')}```",
    ),
}
