"""How well lags and thrust maps of plants drawn at run time are identified.

``python -m benchmarks.identification [--plants 50] [--seed 0]`` writes docs/results/identification_plants.md.
Every plant has four lags of 0.01 to 0.08 s and a thrust curve of its own, in equations that share nothing
with the simulator. It is flown for two minutes and identified from four logs: clean, measured by common
sensors, the same without accelerometer, and with velocity and attitude only (besides the battery).
"""

import argparse
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks import report
from benchmarks.hidden import Truth
from benchmarks.loop.plants import HiddenPlant
from flytrack_env.state import ACTION_SIZE
from flytrack_sysid import collect, fit
from flytrack_sysid.log import FlightLog
from flytrack_sysid.parameters import TAUS, THRUST_COEFFS
from flytrack_sysid.sensors import measure

PAGE = report.RESULTS / "identification_plants.md"
TAU_RANGE_S = (0.01, 0.08)
MINUTES = 2.0
# Aims for each kind of log: largest error of a lag, and of the thrust map over full thrust.
AIMS = {
    "clean": (1e-4, 1e-4),
    "sensors": (0.02, 0.005),
    "no accelerometer": (0.04, 0.01),
    "velocity and attitude only": (0.04, 0.01),
}
HEADER = (
    "log | lags: worst error of any plant | aim | median | thrust map: worst, of full thrust | aim | "
    "median | truth inside the 95 % interval | CPU s a fit, median / largest"
)
COVERAGE_AIM = (0.90, 0.99)


def draw_truth(rng: np.random.Generator) -> Truth:
    """Return a plant whose thrust grows from about 0 at idle to 2 to 5 times its weight."""
    low, quadratic, cubic = rng.uniform(-9.0, -6.0), rng.uniform(1.0, 5.0), rng.uniform(-1.0, 1.0)
    per_volt, idle = rng.uniform(0.7, 1.2), rng.uniform(0.0, 1.0)
    # (1 + u) (low + quadratic u + cubic u^2 + per_volt V) + idle
    coeffs = [low + idle, low + quadratic, quadratic + cubic, cubic, per_volt, per_volt]
    return Truth(tuple(rng.uniform(*TAU_RANGE_S, ACTION_SIZE)), tuple(coeffs))


def terms(action: np.ndarray, battery_v: np.ndarray) -> np.ndarray:
    """Return 1, u, u^2, u^3, V, u V; (..., 6)."""
    columns = (np.ones_like(action), action, action**2, action**3, battery_v, action * battery_v)
    return np.stack(columns, axis=-1)


class Outcome(NamedTuple):
    """One identification: largest relative errors, intervals that cover the truth (10,), s of CPU time."""

    tau_error: float
    map_error: float
    covers: np.ndarray
    seconds: float


def identify(log: FlightLog, truth: Truth) -> Outcome:
    """Return how a fit compares with the truth."""
    started = time.process_time()
    found = fit(log)
    seconds = time.process_time() - started
    values = found.estimate.model
    box = terms(*np.meshgrid(np.linspace(-1, 1, 41), np.linspace(22, 24, 21)))
    map_error = np.abs(box @ (np.asarray(values.thrust_coeffs) - truth.coeffs)).max()
    truths = dict(zip((*TAUS, *THRUST_COEFFS), (*truth.tau, *truth.coeffs), strict=True))
    covers = [
        found.intervals[name].low <= value <= found.intervals[name].high for name, value in truths.items()
    ]
    tau_error = np.abs(np.asarray(values.tau) / truth.tau - 1.0).max()
    return Outcome(tau_error, map_error / (box @ truth.coeffs).max(), np.array(covers), seconds)


def run(num_plants: int, seed: int) -> dict[str, list[Outcome]]:
    """Return outcomes by kind of log."""
    outcomes: dict[str, list[Outcome]] = {name: [] for name in AIMS}
    for number in report.progress(range(num_plants), "plants"):
        rng = np.random.default_rng([seed, number])
        truth = draw_truth(rng)
        clean = collect(HiddenPlant(truth), MINUTES, seed=number)
        sensors = measure(clean, 1.0, truth.gravity, rng)
        without = (), ("f",), ("f", "w", "p")
        logs = dict(zip(AIMS, (clean, *(sensors.without(*names) for names in without)), strict=True))
        for name, log in logs.items():
            outcomes[name].append(identify(log, truth))
    return outcomes


def rows_of(outcomes: dict[str, list[Outcome]]) -> list[tuple[str, ...]]:
    """Return a row of the table per kind of log."""
    rows = []
    for name, found in outcomes.items():
        tau, thrust = np.array([[one.tau_error, one.map_error] for one in found]).T
        seconds = [one.seconds for one in found[1:] or found]  # the first compiles
        cover = "" if name == "clean" else f"{np.mean([one.covers for one in found]):.1%}"
        times = f"{np.median(seconds):.1f} / {max(seconds):.1f}"
        cells = [f"{tau.max():.4%}", f"{AIMS[name][0]:.2%}", f"{np.median(tau):.4%}"]
        cells += [f"{thrust.max():.4%}", f"{AIMS[name][1]:.2%}", f"{np.median(thrust):.4%}"]
        rows.append((name, *cells, cover, times))
    return rows


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plants", type=int, default=50, help="number of plants")
    parser.add_argument("--seed", type=int, default=0, help="of the plants and logs")
    parser.add_argument("--page", type=Path, default=PAGE, help="page to write")
    arguments = parser.parse_args()
    report.pin_to_one_core()
    table = report.table(HEADER, rows_of(run(arguments.plants, arguments.seed)))
    report.fill_page(arguments.page, "identification", table=table, aim=COVERAGE_AIM)


if __name__ == "__main__":
    main()
