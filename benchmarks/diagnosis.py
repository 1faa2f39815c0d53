"""How well the diagnosis names hidden effects, on plants drawn at run time.

``python -m benchmarks.diagnosis [--plants 200] [--rows clean,one,...] [--motion fine,...] [--rate
100,...]`` flies every plant for a minute (benchmarks.hidden), shows the diagnosis the log and the
model without the hidden effects, and grades the result by what the log could show
(benchmarks.hidden.oracle). It appends a line a plant to docs/results/diagnosis.jsonl, with the
commit and versions it was measured at, and skips plants that have a line of a commit with the same
``CODE``. ``python -m benchmarks.diagnosis_page`` writes the page of the last line's code.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from benchmarks import hidden
from benchmarks.hidden.oracle import known, removed, signal_to_noise
from benchmarks.report import IN_THIS_PROCESS, RESULTS, JobFlags, Line, command, record_trials
from flytrack_bench.misspec.suite import nominal_model
from flytrack_env.dynamics import ModelParameters
from flytrack_env.motion import Motion
from flytrack_sysid.diagnosis import Cause, diagnose
from flytrack_sysid.log import FlightLog
from flytrack_sysid.split import held_out_rows

LINES = RESULTS / "diagnosis.jsonl"
# What decides a line.
CODE = (
    "flytrack_env",
    "flytrack_sysid",
    "flytrack_bench/hidden",
    "flytrack_bench/misspec/suite.py",
    "benchmarks/diagnosis.py",
    "benchmarks/hidden",
    "benchmarks/misspec/replay.py",
)
SECONDS = 60.0
SEED = 29  # no rule was made on it; on 21 to 28 some were
# How the package calls the plants' motions.
MOTION_OF = {
    "handout": Motion.EULER,
    "semi_implicit": Motion.SEMI_IMPLICIT,
    "fine": Motion.CONTINUOUS,
}
AMPLITUDES = (0.5, 3.0)  # of effects outside the list, times the noise
Rng = np.random.Generator
model_of = nominal_model  # of a plant, as its team believes


class Trial(NamedTuple):
    """One plant: its row and number, the seed, how it moves, and rows of its log per second."""

    row: str
    number: int
    seed: int
    motion: str = "handout"
    rate: int = 100


def _outside(rng: Rng) -> hidden.Truth:
    truth, amplitude = hidden.draw_base(rng), hidden.log_uniform(*AMPLITUDES, rng)
    return replace(truth, outside=hidden.draw_outside(rng, amplitude=amplitude))


# Row -> how a truth is drawn, and the sensors' noise.
ROWS: dict[str, tuple[Callable[[Rng], hidden.Truth], str]] = {
    "clean": (hidden.draw_base, "sensors"),
    "heavy": (hidden.draw_base, "heavy"),
    "coloured": (hidden.draw_base, "coloured"),
    "gusts": (lambda rng: replace(hidden.draw_base(rng), gust=hidden.draw_gust(rng)), "sensors"),
    "one": (lambda rng: hidden.draw_truth(rng, 1), "sensors"),
    "two": (lambda rng: hidden.draw_truth(rng, 2), "sensors"),
    "three": (lambda rng: hidden.draw_truth(rng, 3), "sensors"),
    "outside": (_outside, "sensors"),
    "clock": (hidden.draw_late, "sensors"),
    "onset": (lambda rng: hidden.draw_onset(rng, SECONDS), "sensors"),
}


def make_log(
    trial: Trial, seconds: float = SECONDS
) -> tuple[hidden.Truth, FlightLog, FlightLog, ModelParameters, Rng]:
    """Return a plant, its clean and its noisy flight, its team's model, and its generator.

    The generator is the random one that drew the plant.

    The plant's parameters do not depend on its motion and the log's rate.
    """
    draw, noise = ROWS[trial.row]
    rng = np.random.default_rng([trial.seed, trial.number, list(ROWS).index(trial.row)])
    truth = replace(draw(rng), motion=trial.motion, step_s=1.0 / trial.rate)
    clean = hidden.fly(truth, seconds, rng)
    return truth, clean, hidden.measure(clean, noise, rng), model_of(truth), rng


def plant(trial: Trial) -> Line:
    """Return the diagnosis of one plant, graded."""
    truth, clean, log, model, rng = make_log(trial)
    started = time.process_time()
    diagnosis = diagnose(log, model)
    seconds = time.process_time() - started
    line: Line = {
        "truth": truth.text(),
        "effects": list(truth.effects),
        "verdict": diagnosis.verdict,
        "is_motion_right": diagnosis.extended.motion is MOTION_OF[truth.motion],
        "causes": [_grade_cause(cause, truth) for cause in diagnosis.causes],
        "negligible": [_grade_cause(cause, truth) for cause in diagnosis.negligible],
        "beyond_the_list": [cause.effect for cause in diagnosis.beyond],
        "unexplained": round_values(diagnosis.unexplained.shares),
        "not_identifiable": [one.effect for one in diagnosis.not_identifiable],
        "cpu_s": round(seconds, 2),
    }
    if truth.onset_s is not None:
        line["onset"] = round(truth.onset_s, 3)
    elif truth.effects:
        true_model = model._replace(motion=MOTION_OF[truth.motion])
        visibility = known(clean, log, ~held_out_rows(log), true_model, truth.effects)
        line["known"] = {
            name: [float(f"{one.lambda_:.4g}"), float(f"{one.lambda_sep:.4g}"), one.rival]
            for name, one in visibility.items()
        }
        # Of explainable error on a new flight, and how large that is, times the noise.
        share, size = removed(hidden.fly(truth, SECONDS, rng), diagnosis.base, diagnosis.extended)
        line["removed"] = [round(share, 4), round(size, 4)]
    if trial.row == "clock":
        latencies_s = [
            cause.parameters["latency_s"].value
            for cause in diagnosis.causes
            if cause.effect == "mocap_latency"
        ]
        line["late_s"] = [round(truth.mocap_late_s, 5), round((*latencies_s, 0.0)[0], 5)]
    if truth.outside is not None:
        line["depends_on"] = truth.outside.kind
        line["amplitude"] = round(truth.outside.amplitude, 3)
        line["visible"] = round(float(signal_to_noise(truth, clean)), 1)
    return line


def round_values(values: Mapping[str, float]) -> dict[str, float]:
    """Return values rounded for a line."""
    return {name: round(value, 3) for name, value in values.items()}


def _grade_cause(cause: Cause, truth: hidden.Truth) -> Line:
    """Return a cause's name, when it acts, and, by parameter, true value, estimate and interval."""
    true = truth.effects.get(cause.effect, {})
    times = {"onset_s": cause.onset_s, "end_s": cause.end_s}
    return {
        "effect": cause.effect,
        **{name: np.round((t.value, *t.ci95), 3).tolist() for name, t in times.items() if t},
        "equivalent": list(cause.equivalent),
        "gain": float(f"{cause.chi2_gain:.4g}"),
        "heldout": float(f"{cause.heldout_gain:.4g}"),
        "intervals": {
            name: [float(f"{value:.5g}") for value in (true[name], one.value, *one.ci95)]
            for name, one in cause.parameters.items()
            if name in true
        },
    }


def main(
    plants: int = 200,
    first: int = 0,
    rows: str = ",".join(ROWS),
    motion: str = ",".join(hidden.MOTIONS),
    rate: str = "100",
    seed: int = SEED,
    jobs: JobFlags = IN_THIS_PROCESS,
) -> None:
    """Diagnose plants.

    Args:
        plants: of each row, up to this number.
        first: from this one on.
        rate: rows per second of the log.
    """
    every = product(
        range(first, plants), rows.split(","), motion.split(","), map(int, rate.split(","))
    )
    trials = [Trial(row, number, seed, moved, per_s) for number, row, moved, per_s in every]
    record_trials(LINES, trials, plant, jobs=jobs, code=CODE)


if __name__ == "__main__":
    command(main)
