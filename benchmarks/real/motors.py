"""Measured flights from their motors: ``python -m benchmarks.real.motors``.

The first half of each flight is learnt from, the second is predicted, beside a linear ARX of the
same motors and rates. Then comes the rotor drag of a simulated flight of others (PX4 in Gazebo),
whose truth is known. Alone (``--only``) run: diagnoses of two flights of NanoBench from motors and
from sticks, which predict two others; the torque that each flight shows; loops between sticks and
motors of Betaflight, beside the settings in its logs; and diagnoses of four flights of one craft.
Flights come from ``benchmarks.real.crazyflie.DATA``.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import orangebox

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
from flytrack_env import ModelParameters
from flytrack_sysid import FitError, FlightLog, diagnose, fit, import_log
from flytrack_sysid.diagnosis.controller import AXES, examine_controller, identify_loops
from flytrack_sysid.diagnosis.result import RateLoop
from flytrack_sysid.fit import Interval
from flytrack_sysid.importing.importer import Imported
from flytrack_sysid.inference.chunks import at_usual_rate
from flytrack_sysid.inference.free_flight import (
    HORIZONS_S,
    QUANTITIES,
    evaluate_windows,
    make_windows,
)
from flytrack_sysid.inference.torque import MotorRecord, torque_correlations
from flytrack_sysid.log import median_step
from flytrack_sysid.split import held_out_rows

HORIZON = HORIZONS_S.index(0.25)
RATES = QUANTITIES.index("rates")
SPACING_S = 0.1
ROTOR_DRAG = 0.0378  # s/m, of the Gazebo flight: its data's README
LAGS = {"motors.up_s": 0.02, "motors.down_s": 0.03}
PARTS = {"Betaflight 6S": 1, "Gecko": 6}  # of a log: a flight of less than 20 s has no parts
PID_SCALES = (0.032029, 0.244381, 0.000529)  # of P, I and D: Betaflight's pid.h
DSHOT_LOW = 48  # a motor that is off
RATE_POLICIES = ("seed00048_log1", "seed00048_log2", "seed00066_log2", "seed00069_log2")
PHOENIX = f"crazyflie_rate_flights/{RATE_POLICIES[0]}.csv.gz"
NANOBENCH_LEARNT = ("B8_star_fast_rep1", "B9_trefoil_fast_rep14")
NANOBENCH_HELD = ("B7_oval_fast_rep1", "B10_lissajous_fast_rep1")
NANOBENCH_ERRORS = (("position_m", "0.5"), ("attitude_rad", "0.25"), ("rates_rad_per_s", "0.25"))


class Craft(NamedTuple):
    """A craft's files, format and mapping, and the values that are not fitted."""

    files: tuple[str, ...]
    format: str
    mapping: str
    fixed: Mapping[str, float] = {}


ARPL_YAW = Craft(("cf_arpl_motors/log16",), "usd", "arpl_motors_log16")
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
    # Even: an ARX has as many rows in any part.
    even_s = median_step(log) * np.arange(len(log))
    log = replace(log, time=even_s, segment=np.zeros(len(log), int))
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


def fit_craft(craft: Craft, effects: tuple[str, ...] = ()) -> Mapping[str, Interval]:
    """Return the intervals of a fit to a craft's flight."""
    flight = read(craft)
    return fit(flight.log, flight.nominal_model(), effects=effects, accept=True).intervals


def compare_flights() -> dict[str, Any]:
    """Return what diagnoses of flights of one craft say of its motors, and which of it agrees.

    Agreement: by parameter, pairs of flights whose intervals overlap, and all pairs.
    """
    intervals: dict[str, dict[str, list[float]]] = {}
    for name in RATE_POLICIES:
        path = DATA / f"crazyflie_rate_flights/{name}.csv.gz"
        flight = import_log(path, "csv", MAPPINGS / "phoenix_motors.toml")
        changed = diagnose(flight.log, flight.nominal_model()).changed
        intervals[name] = {
            one.name: [one.value, *one.ci95] for one in changed if one.name.startswith("motors.")
        }
        print(name, intervals[name], flush=True)
    agreement: dict[str, list[int]] = {}
    for first, second in itertools.combinations(intervals.values(), 2):
        for name in first.keys() & second.keys():
            (_, low, high), (_, other_low, other_high) = first[name], second[name]
            overlaps = low <= other_high and other_low <= high
            counts = agreement.setdefault(name, [0, 0])
            agreement[name] = [counts[0] + overlaps, counts[1] + 1]
    return {"intervals": intervals, "agreement": agreement}


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
        "Crazyflie, log16": read(ARPL_YAW),
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


def controllers() -> dict[str, Any]:
    """Return the loops between sticks and motors of two crafts, and what their logs state.

    Betaflight's gains are whole numbers times a scale (its ``pid.h``), per thousandth of the range
    between idle and full.
    """
    result: dict[str, Any] = {}
    for name, num_parts in PARTS.items():
        craft = CRAFTS[name]
        flight = read(craft)
        log, model = flight.log, flight.nominal_model()
        settings = orangebox.Parser.load(str(DATA / craft.files[0])).headers
        low, high = settings["motorOutput"]
        idle = (high - low) / (high - DSHOT_LOW)
        stated = {}
        for axis, full_stick in zip(AXES, model.max_rate, strict=True):
            gain, integral, derivative = (
                scale * setting
                for scale, setting in zip(PID_SCALES, settings[f"{axis}PID"], strict=True)
            )
            stated[axis] = {
                "full_stick": float(full_stick),
                "gain": 10.0 * gain * idle,
                "integral": integral / gain,
                "derivative": derivative / gain,
            }
        parts = [log.select(rows) for rows in np.array_split(np.arange(len(log)), num_parts)]
        loops, *of_parts = (
            identify_loops(part, model, held_out_rows(part)) for part in (log, *parts)
        )
        sticks = log["sticks"]
        spoiled = {
            "sticks times 1.5": 1.5 * sticks,
            "roll and pitch exchanged": sticks[:, [1, 0, 2, 3]],
        }
        result[name] = {
            "stated": stated,
            "faults": {
                change: _faults(replace(log, channels={**log.channels, "sticks": values}), model)
                for change, values in {"none": sticks, **spoiled}.items()
            },
            "found": _values(loops),
            "parts": [_values(loops_of_part) for loops_of_part in of_parts],
        }
    return result


def _faults(log: FlightLog, model: ModelParameters) -> tuple[str, ...]:
    controller = examine_controller(log, model, held_out_rows(log))
    return () if controller is None else controller.faults


def _values(loops: Sequence[RateLoop]) -> dict[str, dict[str, Any]]:
    """Return the values of loops with half of their intervals, by axis."""
    return {
        loop.axis: {
            "explained": loop.explained,
            **{
                name: [getattr(loop, name).value, getattr(loop, name).half_width]
                for name in ("full_stick", "gain", "integral", "derivative", "feedforward")
            },
            "delays_s": [loop.stick_delay_s, loop.gyro_delay_s],
        }
        for loop in loops
    }


PARTIAL = {
    "nanobench": nanobench,
    "torque": torques,
    "controller": controllers,
    "flights": compare_flights,
}


def main(
    out: Path | None = None,
    only: Literal["all", "nanobench", "torque", "controller", "flights"] = "all",
) -> None:
    """Measure and print; out: a file of JSON values."""
    results: dict[str, Any] = {"commit": report.commit_of_checkout()}
    if only != "all":
        results[only] = PARTIAL[only]()
        for name, value in results[only].items():
            print(name, value if only != "nanobench" or name == "ratios" else "")
        if out is not None:
            report.write_json(out, results)
        return
    for name, craft in CRAFTS.items():
        try:
            results[name] = predicted(craft)
        except FitError as error:
            results[name] = str(error)
        print(name, results[name], flush=True)
    drag = fit_craft(IRIS, ("rotor_drag", "linear_drag"))["rotor_drag.h"]
    results["rotor drag"] = list(drag)
    print("rotor drag", drag, drag.low <= ROTOR_DRAG <= drag.high)
    if out is not None:
        report.write_json(out, results)


if __name__ == "__main__":
    report.command(main)
