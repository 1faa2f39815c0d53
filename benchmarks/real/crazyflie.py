"""Crazyflie flights: models refined on all other policies' flights judge those of each policy.

``python -m benchmarks.real.crazyflie [--policies 50,66] [--seconds 30]`` learns from at most so
many seconds of each other policy, and judges on the left-out flights, which the models never see,
beside black boxes that are trained on the same rows. The effects in question are those that single
steps propose, and drag, which every drone has (``PROPOSED``; a search for each policy would take
hours); which of them stay, and all values, are found without the left-out policy. It appends a line
of JSON for each policy to benchmarks/data/real/crazyflie.jsonl. ``python -m benchmarks.real_logs``
writes the page.
"""

import os
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from benchmarks import report
from benchmarks.real.black_boxes import (
    base_steps,
    fit_linear_boxes,
    fit_network,
    fly_windows,
    rows_of,
)
from benchmarks.report import ROOT, Line, table
from flytrack_env.dynamics import ModelParameters
from flytrack_sysid import FlightLog, import_log
from flytrack_sysid.diagnosis import flight_errors, joined, refinement
from flytrack_sysid.diagnosis.diagnose import split
from flytrack_sysid.inference.free_flight import HORIZONS_S, QUANTITIES, make_windows
from flytrack_sysid.inference.noise import fit_noise
from flytrack_sysid.inference.parameters import from_vector
from flytrack_sysid.inference.score_test import CANDIDATES
from flytrack_sysid.inference.search import SearchState

VARIABLE, FOLDER = "FLYTRACK_SHARED_DATA", "crazyflie_rate_flights"
DATA = Path(os.environ.get(VARIABLE, ROOT.parent / "shared" / "data"))
LINES = ROOT / "benchmarks" / "data" / "real" / "crazyflie.jsonl"
PROPOSED = ("command_delay", "second_order_rates", "rate_scale", "motor_imbalance", "linear_drag")
SECONDS = 10.0  # learnt from of each policy: 100 s in all
SPACING_S, MAX_WINDOWS = 0.25, 10_000
MAPPING = "crazyflie_phoenix"
FIGURES = (("attitude", 0.1, 0.70), ("attitude", 0.25, 0.83), ("position", 0.5, 0.80))
# Quantities and horizons of the page; the records have all.
SHOWN = (
    *(figure[:2] for figure in FIGURES),
    ("rates", 0.5),
    ("velocity", 0.5),
    ("attitude", 2.0),
    ("position", 2.0),
)
BLACK_BOXES = {
    "fir": "FIR, linear in the commands of 0.3 s",
    "arx": "ARX, linear in commands and its own rates",
    "network": "network on top of the refitted base",
}
OTHERS = {
    "refitted_to_flights": "the base alone, fitted to flights too",
    "placebo": "placebo: the state at the start, no commands",
}
AS_GOOD = 1.005  # rounds to 1.00


def policies_in(folder: Path) -> list[str]:
    """Return the numbers of the policies that have flights."""
    return sorted({file.name[7:9] for file in folder.glob("seed*.csv.gz")})


def load_flights(folder: Path, policies: Sequence[str]) -> tuple[FlightLog, ModelParameters]:
    """Return the flights of policies, and the nominal model."""
    files = [file for name in policies for file in sorted(folder.glob(f"seed000{name}_*.csv.gz"))]
    flight = import_log(files, "csv", MAPPING)
    return flight.log, flight.nominal_model()


def shortened(log: FlightLog, seconds: float) -> FlightLog:
    """Return the first so many seconds of a log, over all its flights."""
    return log.select(np.cumsum(np.diff(log.time, prepend=log.time[0]).clip(0.0, 0.1)) < seconds)


def fit_models(log: FlightLog, nominal: ModelParameters) -> tuple[np.ndarray, refinement.Refined]:
    """Return the base and proposed effects of flights, fitted to single steps, then refined."""
    parts = split(log, nominal, None, None)
    problem, state = parts.train, SearchState.start(log, parts.train)
    candidates = []
    for name in PROPOSED:
        of_effect = [candidate for candidate in CANDIDATES if candidate.effect == name]
        candidates.append(of_effect[len(of_effect) // 2])  # from probes in the middle
    base = state.fitted((), problem.start)
    vector = base.vector.copy()
    for candidate in candidates:
        for field, value in candidate.probes:
            vector[problem.names.index(field)] = value
    model = state.fitted(candidates, vector)
    state = state.with_noise(fit_noise(problem.chunks, problem.residuals(model.vector[None])[0]))
    base, model = state.fitted((), base.vector), state.fitted(candidates, model.vector)
    refined = refinement.refine(state, base, model, log, parts.held_out)
    return base.vector, refined


def measure_fold(folder: Path, policy: str, seconds: float) -> Line:
    """Return what the flights of all policies but one say, and how that predicts the one."""
    others = [name for name in policies_in(folder) if name != policy]
    training = joined([shortened(load_flights(folder, [name])[0], seconds) for name in others])
    log, nominal = load_flights(folder, [policy])
    started = time.process_time()
    base, refined = fit_models(training, nominal)
    cpu_s = time.process_time() - started
    problem, fit = refined.problem, refined.fit
    extended = base if fit is None else fit.vector  # the base's where no effect helps
    windows = make_windows(log, np.ones(len(log), bool), SPACING_S, MAX_WINDOWS)
    vectors = {"refitted_base": base, "extended": extended}
    if refined.base is not None:
        vectors["refitted_to_flights"] = refined.base
    errors = (
        flight_errors.Flights(windows).errors_at(problem, np.stack(list(vectors.values()))).errors
    )
    results = {
        name: flight_errors.FlightErrors(error[None], windows)
        for name, error in zip(vectors, errors, strict=True)
    }
    plain = from_vector(base, problem.like)._replace(effects=())
    rows, steps = rows_of(training, plain), base_steps(plain, log)
    boxes = {**fit_linear_boxes(rows), "network": fit_network(rows)}
    results |= {name: fly_windows(black_box, windows, steps) for name, black_box in boxes.items()}
    seen = make_windows(training, np.ones(len(training), bool), SPACING_S, MAX_WINDOWS)
    results["placebo"] = flight_errors.FlightErrors(
        flight_errors.placebo_errors(seen, windows), windows
    )
    return {
        "policy": policy,
        "rows": len(training),
        "cpu_s": round(cpu_s, 1),
        "kept": [candidate.effect for candidate in refined.kept],
        "removed": refined.removed,
        "removal_costs": refined.removal_costs,
        "rms": {name: tested.rms()[0].round(6).tolist() for name, tested in results.items()},
        "by_flight": error_ratios(
            results["refitted_base"], results["extended"], log.segment[windows.start]
        ),
    }


def error_ratios(
    base: flight_errors.FlightErrors, extended: flight_errors.FlightErrors, segment: np.ndarray
) -> dict[str, list[list[float]]]:
    """Return the extended model's errors over the base's, (horizons, quantities), by flight.

    Args:
        segment: (windows,), the flight of each; 0 where a flight has no window.
    """
    ratios = {}
    for number in np.unique(segment):
        part = segment == number
        windows = extended.windows._replace(counts=extended.windows.counts[:, part])
        base_rms, rms = (
            flight_errors.FlightErrors(model.errors[:, :, part], windows).rms()[0]
            for model in (base, extended)
        )
        ratios[str(number)] = np.nan_to_num(rms / base_rms, nan=0.0).round(4).tolist()
    return ratios


# Its part of the page


def ratios(line: Line, model: str) -> np.ndarray:
    """Return a model's rms errors over the refitted base's, (horizons, quantities)."""
    return np.array(line["rms"][model]) / np.array(line["rms"]["refitted_base"])


def _cell(quantity: str, horizon_s: float) -> tuple[int, int]:
    return HORIZONS_S.index(horizon_s), QUANTITIES.index(quantity)


def _median(lines: list[Line], model: str) -> np.ndarray:
    return np.median(np.stack([ratios(line, model) for line in lines]), axis=0)


def figures_table(lines: list[Line]) -> str:
    """Return the figures: medians over policies, and the same over the best black box."""
    rows = []
    for quantity, horizon, target in FIGURES:
        cell = _cell(quantity, horizon)
        median, *boxes = (_median(lines, name)[cell] for name in ("extended", *BLACK_BOXES))
        name = f"{quantity} after {horizon:g} s"
        figure = report.Figure(name, f"at most {target:.2f}", f"{median:.2f}", len(lines))
        rows.append([*figure, f"{median / min(boxes):.2f}"])
    return table("figure | target | measured | n | over the best black box", rows)


def models_table(lines: list[Line]) -> str:
    """Return the medians over policies of all models, of some quantities and horizons."""
    names = {"extended": "extended model", **OTHERS, **BLACK_BOXES}
    rows = []
    for name, words in names.items():
        measured = [line for line in lines if name in line["rms"]]
        if measured:
            medians = _median(measured, name)
            rows.append([words, *(f"{medians[_cell(*shown)]:.2f}" for shown in SHOWN)])
    heads = [f"{quantity} {horizon:g} s" for quantity, horizon in SHOWN]
    return table(["model", *heads], rows)


def policies_table(lines: list[Line]) -> str:
    """Return how each left-out policy is predicted."""
    rows = []
    for line in lines:
        errors = ratios(line, "extended")
        flights = np.concatenate([np.ravel(cells) for cells in line["by_flight"].values()])
        flights = flights[flights > 0.0]
        values = [*(errors[_cell(*figure[:2])] for figure in FIGURES), np.nanmax(errors)]
        num_worse = f"{np.sum(flights > AS_GOOD)} of {len(flights)}"
        cells = [f"{value:.2f}" for value in values]
        rows.append([line["policy"], *cells, num_worse])
    heads = [f"{quantity} {horizon:g} s" for quantity, horizon, _ in FIGURES]
    header = ["left-out policy", *heads, "largest of all cells"]
    return table([*header, "cells worse, by flight"], rows)


def crazyflie_part() -> str:
    """Return the part of the page, of the last line of each policy."""
    last = {line["policy"]: line for line in report.lines_in(LINES)}
    lines = [last[policy] for policy in sorted(last)]
    kept = Counter(name for line in lines for name in line["kept"])
    return report.filled(
        "real_policies",
        policies=len(lines),
        flights=sum(len(line["by_flight"]) for line in lines),
        figures=figures_table(lines),
        models=models_table(lines),
        kept=", ".join(f"`{name}` {count}" for name, count in kept.most_common()),
        judged=policies_table(lines),
    )


def main(data: Path = DATA, policies: str = "", seconds: float = SECONDS) -> None:
    """Refine and judge for each policy, all by default."""
    folder = data / FOLDER
    LINES.parent.mkdir(parents=True, exist_ok=True)
    with jax.enable_x64(True):
        commit = report.commit_of_checkout()  # before its lines change a file
        chosen = policies.split(",") if policies else policies_in(folder)
        for policy in report.progress(chosen, "policies"):
            report.append_line(LINES, {"commit": commit, **measure_fold(folder, policy, seconds)})


if __name__ == "__main__":
    report.command(main)
