"""Crazyflie flights: each policy's are judged by models that are refined on the flights of all others.

``python -m benchmarks.real.crazyflie [--policies 50,66] [--seconds 30]`` learns from at most so many seconds
of each other policy, and judges on the left-out flights, which the models never see, beside black boxes
that are trained on the same rows. The effects in question are those that single steps propose, and drag,
which every drone has (``PROPOSED``; a search for each policy would take hours); which of them stay, and all
values, are found without the left-out policy. It appends a line of JSON for each policy to
benchmarks/data/real/crazyflie.jsonl. ``--fits`` fits one structure to the flights of each policy alone
instead, to crazyflie_fits.json beside it. ``python -m benchmarks.real_logs`` writes the page.
"""

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks.real.black_boxes import base_steps, flown, linear_ones, network, rows_of
from benchmarks.report import ROOT, append_line, command, commit_of_checkout, lines_in, progress, write_json
from flytrack_env.dynamics import ModelParameters
from flytrack_env.motion import Motion
from flytrack_sysid import FlightLog, import_log
from flytrack_sysid.diagnosis import joined, refinement
from flytrack_sysid.diagnosis.diagnose import split
from flytrack_sysid.diagnosis.lanes import make_lanes, thinned
from flytrack_sysid.diagnosis.noise import first_guess, fit_noise
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.score_test import CANDIDATES
from flytrack_sysid.diagnosis.search import SearchState
from flytrack_sysid.parameters import STICKS, TAUS, THRUST_COEFFS, from_vector
from flytrack_sysid.prediction_windows import make_windows
from flytrack_sysid.response import SMALL_STEP, half_responses

VARIABLE, FOLDER = "FLYTRACK_SHARED_DATA", "crazyflie_rate_flights"
DATA = Path(os.environ.get(VARIABLE, ROOT.parent / "shared" / "data"))
LINES = ROOT / "benchmarks" / "data" / "real" / "crazyflie.jsonl"
FITS = LINES.with_name("crazyflie_fits.json")
PROPOSED = ("command_delay", "second_order_rates", "rate_scale", "motor_imbalance", "linear_drag")
SECONDS = 10.0  # learnt from of each policy: 100 s in all
SPACING_S, MOST = 0.25, 10_000
FEWEST_ROWS = 2000  # of a policy, to fit it alone
MAPPING = "crazyflie_phoenix"


def policies_in(folder: Path) -> list[str]:
    """Return the numbers of the policies that have flights."""
    return sorted({file.name[7:9] for file in folder.glob("seed*.csv.gz")})


def flights(folder: Path, policies: Sequence[str]) -> tuple[FlightLog, ModelParameters]:
    """Return the flights of policies, and the nominal model, moving as drones do."""
    files = [file for one in policies for file in sorted(folder.glob(f"seed000{one}_*.csv.gz"))]
    found = import_log(files, "csv", MAPPING)
    return found.log, found.nominal_model()._replace(motion=Motion.CONTINUOUS)


def shortened(log: FlightLog, seconds: float) -> FlightLog:
    """Return the first so many seconds of a log, over all its flights."""
    return log.select(np.cumsum(np.diff(log.time, prepend=log.time[0]).clip(0.0, 0.1)) < seconds)


class Models(NamedTuple):
    """What the flights of some policies say: a problem, the refitted base, and the refined extension."""

    problem: Problem
    base: np.ndarray
    refined: refinement.Refined

    @property
    def extended(self) -> np.ndarray:
        """The vector of the extended model; the base's where no effect helps."""
        return self.base if self.refined.fit is None else self.refined.fit.vector


def models_of(learnt: FlightLog, nominal: ModelParameters) -> Models:
    """Return the models of flights: base and proposed effects fitted to single steps, then refined."""
    parts = split(learnt, nominal, None, Motion.CONTINUOUS)
    problem = parts.train
    state = SearchState.start(
        learnt, problem.with_noise(first_guess(problem.lanes, problem.residuals(problem.start[None])[0]))
    )
    ways = ([one for one in CANDIDATES if one.effect == name] for name in PROPOSED)
    candidates = [found[len(found) // 2] for found in ways]  # from probes in the middle
    base = state.fitted((), problem.start)
    vector = base.vector.copy()
    for field, value in (probe for one in candidates for probe in one.probes):
        vector[problem.names.index(field)] = value
    model = state.fitted(candidates, vector)
    state = state.with_noise(fit_noise(problem.lanes, problem.residuals(model.vector[None])[0]))
    base, model = state.fitted((), base.vector), state.fitted(candidates, model.vector)
    refined = refinement.refine(
        problem,
        base.vector,
        model.vector,
        candidates,
        state.base_places,
        learnt,
        parts.held_out,
        is_explained=False,
    )
    return Models(problem, base.vector, refined)


def fold(folder: Path, judged: str, seconds: float) -> dict[str, Any]:
    """Return what the flights of all policies but one say, and how that predicts the one."""
    others = [one for one in policies_in(folder) if one != judged]
    learnt = joined([shortened(flights(folder, [one])[0], seconds) for one in others])
    own, nominal = flights(folder, [judged])
    started = time.process_time()
    found = models_of(learnt, nominal)
    cpu_s = time.process_time() - started
    problem, refined = found.problem, found.refined
    windows = make_windows(own, np.ones(len(own), bool), SPACING_S, MOST)
    vectors = {"refitted_base": found.base, "extended": found.extended}
    if refined.base is not None:
        vectors["refitted_to_flights"] = refined.base
    errors = refinement.errors_at(refined.problem, np.stack(list(vectors.values())), windows).errors
    results = {name: refinement.Tested(one[None], windows) for name, one in zip(vectors, errors, strict=True)}
    base = from_vector(found.base, problem.like)._replace(effects=())
    rows, steps = rows_of(learnt, base), base_steps(base, own)
    boxes = {**linear_ones(rows), "network": network(rows)}
    results |= {name: flown(one, windows, steps) for name, one in boxes.items()}
    known = make_windows(learnt, np.ones(len(learnt), bool), SPACING_S, MOST)
    results["placebo"] = refinement.Tested(refinement.placebo_errors(known, windows), windows)
    fit = refined.fit
    widths = {} if fit is None else dict(zip(fit.places, fit.half_widths, strict=True))
    return {
        "policy": judged,
        "rows": len(learnt),
        "cpu_s": round(cpu_s, 1),
        "kept": [one.effect for one in refined.kept],
        "removed": refined.removed,
        "removal_costs": refined.removal_costs,
        "rms": {name: one.rms()[0].round(6).tolist() for name, one in results.items()},
        "by_flight": by_flight(results, own.segment[windows.start]),
        "values": {
            problem.names[place]: [float(found.extended[place]), float(half)]
            for place, half in widths.items()
        },
    }


def by_flight(results: dict[str, refinement.Tested], segment: np.ndarray) -> dict[str, list[list[float]]]:
    """Return the extended model's errors over the base's, (horizons, quantities), by flight."""
    ratios = {}
    for number in np.unique(segment):
        part = segment == number
        windows = results["extended"].windows
        own = windows._replace(counts=windows.counts[:, part])
        tested = (results[name].errors[:, :, part] for name in ("refitted_base", "extended"))
        base, extended = (refinement.Tested(errors, own).rms()[0] for errors in tested)
        ratios[str(number)] = np.nan_to_num(extended / base, nan=0.0).round(4).tolist()  # 0: no window
    return ratios


def fits_of(folder: Path, structure: Sequence[str], start: dict[str, float]) -> list[dict[str, Any]]:
    """Return values of one structure and times to half response, of the flights of each policy alone."""
    result = []
    for policy in progress(policies_in(folder), "policies"):
        log, model = flights(folder, [policy])
        every = np.ones(len(log), bool)
        if len(log) < FEWEST_ROWS:
            continue
        windows = refinement.windows_of(log, every)
        assert windows is not None
        lanes = thinned(make_lanes(log, every, np.asarray(model.tau, float), float(model.g)))
        problem = Problem.of(lanes, model)
        vector = problem.start.copy()
        vector[problem.index(list(start))] = list(start.values())
        scale = refinement.errors_at(problem, vector[None], windows).rms()[0]
        target = refinement.Target(problem, windows, scale, np.ones(scale.shape, bool))
        fields = [name for name in problem.names if name.partition(".")[0] in structure]
        fit = target.fitted(vector, problem.index([*TAUS, *THRUST_COEFFS, *fields]), refinement.MOST_ROUNDS)
        pairs = zip(fit.places, fit.half_widths, strict=True)
        values = {problem.names[place]: [float(fit.vector[place]), float(half)] for place, half in pairs}
        half_s = half_responses(fit.vector[None], problem.like, SMALL_STEP)[0]
        times = dict(zip(STICKS, half_s.tolist(), strict=True))
        result.append({"policy": policy, "values": values, "half_response_s": times})
    return result


def main(data: Path = DATA, policies: str = "", seconds: float = SECONDS, fits: bool = False) -> None:
    """Refine and judge for each policy, all by default, or fit each policy's flights alone."""
    folder = data / FOLDER
    LINES.parent.mkdir(parents=True, exist_ok=True)
    with jax.enable_x64(True):
        if fits:
            last = lines_in(LINES)[-1]
            start = {name: value for name, (value, _) in last["values"].items()}
            write_json(FITS, fits_of(folder, last["kept"], start))
            return
        commit = commit_of_checkout()  # before its lines change a file
        wanted = policies.split(",") if policies else policies_in(folder)
        for policy in progress(wanted, "policies"):
            append_line(LINES, {"commit": commit, **fold(folder, policy, seconds)})


if __name__ == "__main__":
    command(main)
