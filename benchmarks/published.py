"""Flights of public data sets from their motors: their error measures, naive baselines, our model.

``python -m benchmarks.published --layout idsia_nanodrone --train FILES --test FILES`` fits a model
of motors to flights and predicts others; no data set is shipped, the user names the files. Layouts
are mappings (``flytrack_sysid/mappings``), or the path of one, so that other columns need no code.

=================  ===============================================================================
layout             columns
=================  ===============================================================================
idsia_nanodrone    t s; x y z m; vx vy vz m/s; qx qy qz qw; wx wy wz rad/s, body; m1_rads to
                   m4_rads, rad/s (Crazyflie: front right, rear right, rear left, front left)
neurobem           t s; ang vel x y z rad/s; quat x y z w; acc x y z m/s^2, specific force; vel x y
                   z m/s; pos x y z m; mot 1 to 4 rad/s (rear right, front right, rear left, front
                   left); vbat V; FLU
nanobench_motors   as its authors' CSV files: t, p*, q*, v*, imu_*, motor_motor_m*, pwr_pm_vbat
=================  ===============================================================================

Measures: the sum over horizons of 1 to 50 rows of the mean absolute error of position (m), velocity
(m/s), attitude (rad) and rates (rad/s), as the nano-drone benchmark of IDSIA sums it; and the root
mean square residual of force (N) and torque (N m), as NeuroBEM's tables have it.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from benchmarks import report
from flytrack_env.dynamics import ModelParameters
from flytrack_env.model_file import save_model
from flytrack_sysid import FlightLog, fit, import_log
from flytrack_sysid.diagnosis import joined
from flytrack_sysid.importing.importer import Imported
from flytrack_sysid.inference.free_flight import fly_freely
from flytrack_sysid.inference.one_step import columns, predict
from flytrack_sysid.inference.record import fill_gaps

HORIZON, EVERY = 50, 10  # rows: of a flight, and between the starts of flights
SETTLED_S = 0.5  # of the motors, before a flight starts
STATE = ("p", "v", "q", "w")


class Errors(NamedTuple):
    """Sums over horizons of the mean absolute errors; NaN of what was not logged."""

    position: float
    velocity: float
    attitude: float
    rates: float


class Wrench(NamedTuple):
    """Root mean square residuals of force, N, and torque, N m, over all axes."""

    force: float
    torque: float


def start_rows(log: FlightLog) -> np.ndarray:
    """Return the rows from which flights of ``HORIZON`` rows stay within their segment."""
    settled = round(SETTLED_S / float(np.median(np.diff(log.time))))
    bounds = np.append(np.flatnonzero(log.is_start()), len(log))
    return np.concatenate(
        [np.arange(first + settled, last - HORIZON, EVERY) for first, last in pairwise(bounds)]
    )


def errors_of(log: FlightLog, rows: np.ndarray, flown: dict[str, np.ndarray]) -> Errors:
    """Return the errors of flights, (num_rows, HORIZON, size) each, against a log."""
    index = rows[:, None] + np.arange(1, HORIZON + 1)
    sums = []
    for name in STATE:
        if name not in log:
            sums.append(np.nan)
            continue
        measured, predicted = log[name][index], flown[name]
        if name == "q":
            first, second = (
                Rotation.from_quat(values.reshape(-1, 4), scalar_first=True)
                for values in (measured, predicted)
            )
            sizes = (first.inv() * second).magnitude().reshape(index.shape)
        else:
            sizes = np.linalg.norm(measured - predicted, axis=-1)
        sums.append(float(sizes.mean(axis=0).sum()))
    return Errors(*sums)


def held(log: FlightLog, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return the naive prediction: the state at the start."""
    return {
        name: np.repeat(log[name][rows][:, None], HORIZON, axis=1) for name in STATE if name in log
    }


def drifting(log: FlightLog, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return the kinematic prediction: velocity and body rates at the start go on."""
    flown, step_s = held(log, rows), float(np.median(np.diff(log.time)))
    times = step_s * np.arange(1, HORIZON + 1)
    if "p" in log and "v" in log:
        flown["p"] = flown["p"] + log["v"][rows][:, None] * times[:, None]
    attitude = Rotation.from_quat(flown["q"].reshape(-1, 4), scalar_first=True)
    turn = Rotation.from_rotvec((log["w"][rows][:, None] * times[:, None]).reshape(-1, 3))
    flown["q"] = (attitude * turn).as_quat(scalar_first=True).reshape(flown["q"].shape)
    return flown


def wrench_of(model: ModelParameters, log: FlightLog) -> Wrench:
    """Return the residuals of force and torque, by specific force and by changes of the rates."""
    prediction = predict(model, fill_gaps(log))
    log, rows = prediction.log, np.flatnonzero(prediction.is_settled)[:-1]
    rows = rows[~log.is_start()[rows + 1]]
    motors, mass = model.effect("motors"), float(model.m)
    inertia = mass * np.square([motors.radius_x, motors.radius_y, motors.radius_z])
    torque = columns(prediction.after.rates_b)[rows] - log["w"][rows + 1]
    torque = inertia * torque / prediction.step_s
    force = np.nan
    if "f" in log:
        force = _rms(mass * (log["f"][rows + 1] - prediction.force_b[rows]))
    return Wrench(force, _rms(torque))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


class Published(NamedTuple):
    """What is predicted of flights that a model has not seen.

    Attributes:
        model: fitted to the other flights.
        intervals: of its parameters.
        errors: of each prediction.
        wrench: of the model.
        count: flights from which the errors are.
    """

    model: ModelParameters
    intervals: dict[str, Any]
    errors: dict[str, Errors]
    wrench: Wrench
    count: int  # type: ignore[assignment]  # hides tuple.count


def predicted(
    train: Imported,
    test: Imported,
    effects: Sequence[str] = ("linear_drag",),
    fixed: dict[str, float] | None = None,
) -> Published:
    """Return a model of motors fitted to flights, and how well it predicts others."""
    start = train.nominal_model()
    found = fit(train.log, start, fixed, effects, every=0, accept=True)
    log = test.log
    rows = start_rows(log)
    # Rows of a log without gaps are its own.
    filled = fill_gaps(log)
    places = np.searchsorted(filled.source_row[filled.source_row >= 0], rows)
    places = np.flatnonzero(filled.source_row >= 0)[places]
    flown = fly_freely(found.model, filled, places, HORIZON)
    errors = {
        "held": errors_of(log, rows, held(log, rows)),
        "drifting": errors_of(log, rows, drifting(log, rows)),
        "motors": errors_of(log, rows, flown),
    }
    return Published(
        found.model, dict(found.intervals), errors, wrench_of(found.model, log), len(rows)
    )


def leave_one_out(flights: Imported, **settings: Any) -> list[Published]:
    """Return the predictions of each flight by a model of all others."""
    log, results = flights.log, []
    for number in np.unique(log.segment):
        test = replace(flights, log=log.select(log.segment == number))
        train = replace(flights, log=joined([log.select(log.segment != number)]))
        results.append(predicted(train, test, **settings))
    return results


def table_of(results: Sequence[Published]) -> str:
    """Return the errors of predictions, means over results, as a table."""
    rows = []
    for name in results[0].errors:
        means = np.mean([result.errors[name] for result in results], axis=0)
        rows.append([name, *(f"{value:.3f}" for value in means)])
    return report.table("prediction | position m | velocity m/s | attitude rad | rates rad/s", rows)


def main(
    layout: str,
    train: tuple[Path, ...],
    test: tuple[Path, ...] = (),
    effects: tuple[str, ...] = ("linear_drag",),
    fix: tuple[str, ...] = (),
    out: Path | None = None,
) -> None:
    """Fit to flights and predict others, or each flight from the others without ``test``.

    Args:
        layout: a mapping, shipped or a path.
        fix: NAME=VALUE of parameters that are not fitted.
        out: where the model is written.
    """
    fixed = {name: float(value) for name, value in (pair.split("=") for pair in fix)}
    flights = import_log(train, "csv", layout)
    settings: dict[str, Any] = {"effects": effects, "fixed": fixed}
    if test:
        results = [predicted(flights, import_log(test, "csv", layout), **settings)]
    else:
        results = leave_one_out(flights, **settings)
    print(table_of(results))
    print(f"sums of mean errors over horizons of 1 to {HORIZON} rows; {results[0].count} starts")
    for result in results:
        print(
            f"residuals: force {result.wrench.force:.4g} N, torque {result.wrench.torque:.4g} N m"
        )
        for name, (value, low, high) in result.intervals.items():
            print(f"  {name:24} {value:.5g} ({low:.5g} to {high:.5g})")
    if out is not None:
        save_model(out, results[0].model, {"tool": "benchmarks.published", "layout": layout})


if __name__ == "__main__":
    tyro.cli(main)
