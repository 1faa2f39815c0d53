"""Measured flights from their motors: ``python -m benchmarks.real.motors``.

The first half of each flight is learnt from, the second is predicted, beside a linear ARX of the
same motors and rates. Then the parameters of two flights of one craft, and the rotor drag of a
simulated flight of others (PX4 in Gazebo), whose truth is known. Last, two flights of NanoBench are
diagnosed twice, from motors and from sticks, and two others are predicted. Flights come from
``benchmarks.real.crazyflie.DATA``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import tyro

from benchmarks import report
from benchmarks.real.black_boxes import (
    base_steps,
    fit_linear_boxes,
    fly_windows,
    rows_of,
    with_pose,
)
from benchmarks.real.crafts import MAPPINGS, nanobench_flights
from benchmarks.real.crazyflie import DATA, MAX_WINDOWS
from benchmarks.real.section import diagnose_log
from flytrack_sysid import FitError, fit, import_log
from flytrack_sysid.fit import Fit
from flytrack_sysid.importing.importer import Imported
from flytrack_sysid.inference.chunks import at_usual_rate
from flytrack_sysid.inference.free_flight import (
    HORIZONS_S,
    QUANTITIES,
    evaluate_windows,
    make_windows,
)
from flytrack_sysid.inference.torque import MotorRecord, torque_correlations

HORIZON = HORIZONS_S.index(0.25)
RATES = QUANTITIES.index("rates")
SPACING_S = 0.1
ROTOR_DRAG = 0.0378  # s/m, of the Gazebo flight: its data's README
LAGS = {"motors.up_s": 0.02, "motors.down_s": 0.03}
PHOENIX = "crazyflie_rate_flights/seed00048_log1.csv.gz"
NANOBENCH_LEARNT = ("B8_star_fast_rep1", "B9_trefoil_fast_rep14")
NANOBENCH_HELD = ("B7_oval_fast_rep1", "B10_lissajous_fast_rep1")
NANOBENCH_ERRORS = (("position_m", "0.5"), ("attitude_rad", "0.25"), ("rates_rad_per_s", "0.25"))


class Craft(NamedTuple):
    """A craft's files, format and mapping, and the values that are not fitted."""

    files: tuple[str, ...]
    format: str
    mapping: str
    fixed: Mapping[str, float] = {}


CRAFTS = {
    "Betaflight 6S": Craft(("betaflight_acro_log/shortLog.BFL",), "betaflight", "acro_motors"),
    "Gecko": Craft(("bf_gecko/btfl_002.bbl",), "betaflight", "gecko_motors", LAGS),
    "Crazyflie, log15": Craft(("cf_arpl_motors/log15",), "usd", "arpl_motors_log15"),
}
IRIS = Craft(("eth_quadrotor_model/quadrotor_model.csv",), "csv", "eth_motors")


def read(craft: Craft) -> Imported:
    """Return the flight of a craft."""
    files = [DATA / file for file in craft.files]
    return import_log(files, craft.format, MAPPINGS / f"{craft.mapping}.toml")


def predicted(craft: Craft) -> dict[str, float]:
    """Return the errors of the rates after 0.25 s in the second half, rms in rad/s, and sizes."""
    flight = read(craft)
    log = at_usual_rate(flight.log)[0]
    step_s = float(np.median(np.diff(log.time)))  # even: an ARX has as many rows in any part
    log = replace(log, time=step_s * np.arange(len(log)), segment=np.zeros(len(log), int))
    is_test = np.arange(len(log)) >= len(log) // 2
    train = log.select(~is_test)
    found = fit(train, flight.nominal_model(), craft.fixed, every=0, accept=True)
    windows = make_windows(log, is_test, SPACING_S, MAX_WINDOWS)
    boxes = fit_linear_boxes(rows_of(with_pose(train), found.model))
    base = base_steps(found.model, with_pose(log))
    errors = {
        "motors": evaluate_windows(found.model, windows),
        "arx": fly_windows(boxes["arx"], windows, base).errors[0],
    }
    counts = windows.counts[HORIZON, :, RATES]
    result = {
        name: float(np.sqrt(np.mean(np.sum(values[HORIZON, counts, RATES] ** 2, axis=-1))))
        for name, values in errors.items()
    }
    return {**result, "ratio": result["motors"] / result["arx"], "windows": int(counts.sum())}


def overlap(fits: Sequence[Fit]) -> tuple[list[bool], list[str]]:
    """Return whether the intervals of two flights overlap, by parameter, and the parameters."""
    first, second = (one.intervals for one in fits)
    names = [name for name in first if name in second and name.startswith("motors.")]
    flags = [
        first[name].low <= second[name].high and second[name].low <= first[name].high
        for name in names
    ]
    return flags, names


def two_flights() -> list[Fit]:
    """Return the fits of two flights of one Crazyflie."""
    fits = []
    for name in ("log15", "log16"):
        craft = Craft((f"cf_arpl_motors/{name}",), "usd", f"arpl_motors_{name}")
        flight = read(craft)
        fits.append(fit(flight.log, flight.nominal_model(), accept=True))
    return fits


def rotor_drag() -> Fit:
    """Return the fit of the flight in Gazebo, with linear and rotor drag."""
    flight = read(IRIS)
    return fit(
        flight.log, flight.nominal_model(), effects=("rotor_drag", "linear_drag"), accept=True
    )


def nanobench() -> dict[str, Any]:
    """Return the diagnoses of NanoBench from motors and from sticks, and error ratios on others.

    The ratios are of held-out errors of both extended models, motors over sticks.
    """
    records = {}
    for kind, mapping in (("motors", "nanobench_motors"), ("sticks", "nanobench")):
        log, nominal = nanobench_flights(DATA, (*NANOBENCH_LEARNT, *NANOBENCH_HELD), mapping)
        held_out = log.segment >= len(NANOBENCH_LEARNT)
        records[kind] = diagnose_log(log, nominal, held_out)[1]
        print(kind, records[kind]["sentence"], f"{records[kind]['cpu_s']:.0f} CPU s", flush=True)
    errors = {kind: record["diagnosis"]["prediction"]["errors"] for kind, record in records.items()}
    ratios = {
        f"{quantity} after {horizon} s": errors["motors"]["extended"][quantity][horizon]
        / errors["sticks"]["extended"][quantity][horizon]
        for quantity, horizon in NANOBENCH_ERRORS
    }
    kept = ("num_rows", "cpu_s", "sentence")
    shown = {kind: {name: one[name] for name in kept} for kind, one in records.items()}
    return {"ratios": ratios, "errors": errors, **shown}


def torques() -> dict[str, list[float]]:
    """Return how changes of roll and pitch rate correlate with the motors' torque, by flight."""
    phoenix = MAPPINGS / "phoenix_motors.toml"
    flights = {
        **{name: read(craft) for name, craft in CRAFTS.items()},
        "Crazyflie, log16": read(Craft(("cf_arpl_motors/log16",), "usd", "arpl_motors_log16")),
        "Crazyflie, rate policy": import_log(DATA / PHOENIX, "csv", phoenix),
        "Gazebo's iris": read(IRIS),
    }
    for name in (*NANOBENCH_LEARNT, *NANOBENCH_HELD):
        path = DATA / "nanobench" / f"{name}.csv.gz"
        flights[f"NanoBench, {name}"] = import_log(path, "csv", "nanobench_motors")
    return {
        name: torque_correlations(flight.nominal_model(), MotorRecord.of_log(flight.log)).tolist()
        for name, flight in flights.items()
    }


def main(out: Path | None = None, only: Literal["all", "nanobench", "torque"] = "all") -> None:
    """Measure and print; out: a file of JSON values."""
    results: dict[str, Any] = {"commit": report.commit_of_checkout()}
    if only != "all":
        results[only] = nanobench() if only == "nanobench" else torques()
        for name, value in results[only].items():
            print(name, value if only == "torque" or name == "ratios" else "")
        if out is not None:
            report.write_json(out, results)
        return
    for name, craft in CRAFTS.items():
        try:
            results[name] = predicted(craft)
        except FitError as error:
            results[name] = str(error)
        print(name, results[name], flush=True)
    fits = two_flights()
    flags, names = overlap(fits)
    results["two flights"] = {
        name: [list(one.intervals[name]) for one in fits] + [flag]
        for name, flag in zip(names, flags, strict=True)
    }
    print(f"overlapping: {sum(flags)} of {len(flags)}", results["two flights"], flush=True)
    drag = rotor_drag().intervals["rotor_drag.h"]
    results["rotor drag"] = list(drag)
    print("rotor drag", drag, drag.low <= ROTOR_DRAG <= drag.high)
    if out is not None:
        report.write_json(out, results)


if __name__ == "__main__":
    tyro.cli(main)
