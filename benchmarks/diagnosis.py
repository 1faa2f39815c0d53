"""How well the diagnosis names hidden effects, on plants drawn at run time.

``python -m benchmarks.diagnosis [--plants 200] [--rows clean,one,...] [--motion fine,...] [--rate
100,...]`` flies every plant for a minute (benchmarks.hidden), shows the diagnosis the log and the
model without the hidden effects, and grades the result by what the log could show
(benchmarks.hidden.oracle). It appends a line a plant to docs/results/diagnosis.jsonl, with the
commit and versions it was measured at, and skips plants that have a line of the same commit.
``python -m benchmarks.diagnosis_page`` writes the page of the last commit's lines.
"""

import os
import platform
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from itertools import product
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks import hidden
from benchmarks.hidden.oracle import known, removed, signal_to_noise
from benchmarks.report import (
    RESULTS,
    append_line,
    command,
    commit_of_checkout,
    lines_of_commit,
    progress,
)
from flytrack_env.dynamics import ModelParameters
from flytrack_env.motion import Motion
from flytrack_sysid.diagnosis import diagnose
from flytrack_sysid.log import FlightLog
from flytrack_sysid.split import held_out_rows

LINES = RESULTS / "diagnosis.jsonl"
SECONDS = 60.0
SEED = 29  # no rule was made on it; on 21 to 28 some were
# How the package calls the plants' motions.
MOTION_OF = {
    "handout": Motion.HANDOUT,
    "semi_implicit": Motion.SEMI_IMPLICIT,
    "fine": Motion.CONTINUOUS,
}
AMPLITUDES = (0.5, 3.0)  # of effects outside the list, times the noise
Rng = np.random.Generator


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


def model_of(truth: hidden.Truth) -> ModelParameters:
    """Return the model that a plant's team believes in; they do not know how the plant moves."""
    return ModelParameters(
        tau=np.array(truth.tau, np.float32),
        thrust_coeffs=np.array(truth.coeffs, np.float32),
        max_rate=np.array(truth.max_rate, np.float32),
        m=truth.mass,
        g=truth.gravity,
        battery_drain_v_per_min=truth.drain,
    )


def make_log(trial: Trial) -> tuple[hidden.Truth, FlightLog, FlightLog, ModelParameters, Rng]:
    """Return a plant, its clean and its noisy flight, its team's model, and its generator.

    The generator is the random one that drew the plant.

    The plant's parameters do not depend on its motion and the log's rate.
    """
    draw, noise = ROWS[trial.row]
    rng = np.random.default_rng([trial.seed, trial.number, list(ROWS).index(trial.row)])
    truth = replace(draw(rng), motion=trial.motion, step_s=1.0 / trial.rate)
    clean = hidden.fly(truth, SECONDS, rng)
    return truth, clean, hidden.measure(clean, noise, rng), model_of(truth), rng


def plant(trial: Trial) -> dict[str, Any]:
    """Return the diagnosis of one plant, graded."""
    truth, clean, log, model, rng = make_log(trial)
    started = time.process_time()
    found = diagnose(log, model)
    seconds = time.process_time() - started
    line: dict[str, Any] = {
        "truth": truth.text(),
        "effects": list(truth.effects),
        "verdict": found.verdict,
        "is_motion_right": found.extended.motion is MOTION_OF[truth.motion],
        "causes": [_graded(cause, truth) for cause in found.causes],
        "negligible": [_graded(cause, truth) for cause in found.negligible],
        "beyond_the_list": [cause.effect for cause in found.beyond],
        "unexplained": {name: round(size, 3) for name, size in found.unexplained.shares.items()},
        "not_identifiable": [one.effect for one in found.not_identifiable],
        "cpu_s": round(seconds, 2),
    }
    if truth.onset_s is not None:
        line["onset"] = round(truth.onset_s, 3)
    elif truth.effects:
        true_model = model._replace(motion=MOTION_OF[truth.motion])
        could = known(clean, log, ~held_out_rows(log), true_model, truth.effects)
        line["known"] = {
            name: [float(f"{v:.4g}") for v in one[:2]] + [one[2]] for name, one in could.items()
        }
        # Of explainable error on a new flight, and how large that is, times the noise.
        share, size = removed(hidden.fly(truth, SECONDS, rng), found.base, found.extended)
        line["removed"] = [round(share, 4), round(size, 4)]
    if trial.row == "clock":
        late = [one for one in found.causes if one.effect == "mocap_latency"]
        found_s = late[0].parameters["latency_s"].value if late else 0.0
        line["late_s"] = [round(truth.mocap_late_s, 5), round(found_s, 5)]
    if truth.outside is not None:
        line["depends_on"] = truth.outside.kind
        line["amplitude"] = round(truth.outside.amplitude, 3)
        line["visible"] = round(float(signal_to_noise(truth, clean)), 1)
    return line


def _graded(cause: Any, truth: hidden.Truth) -> dict[str, Any]:
    """Return a cause's name, when it acts, and, by parameter, true value, estimate and interval."""
    true = truth.effects.get(cause.effect, {})
    spans = {"onset_s": cause.onset_s, "end_s": cause.end_s}
    return {
        "effect": cause.effect,
        **{
            name: [round(x, 3) for x in (one.value, *one.ci95)]
            for name, one in spans.items()
            if one
        },
        "equivalent": list(cause.equivalent),
        "gain": float(f"{cause.chi2_gain:.4g}"),
        "heldout": float(f"{cause.heldout_gain:.4g}"),
        "intervals": {
            name: [float(f"{value:.5g}") for value in (true[name], one.value, *one.ci95)]
            for name, one in cause.parameters.items()
            if name in true
        },
    }


def read_lines(commit: str | None) -> dict[Trial, dict[str, Any]]:
    """Return the lines of a commit by plant; of the last line's if None."""
    return {
        Trial(*(line[name] for name in Trial._fields)): line
        for line in lines_of_commit(LINES, commit)
    }


def run(trials: list[Trial]) -> None:
    """Diagnose what is not done yet and append the lines."""
    commit = commit_of_checkout()
    done = read_lines(commit)
    machine = f"{platform.machine()}, {os.cpu_count()} cores, jax {jax.__version__}"
    for trial in progress([one for one in trials if one not in done], "plants"):
        line = {**trial._asdict(), "commit": commit, "date": str(date.today()), "machine": machine}
        try:
            line |= plant(trial)
        except Exception as error:  # a crash is a result too, and the others go on
            line["error"] = f"{type(error).__name__}: {error}"
        append_line(LINES, line)


def main(
    plants: int = 200,
    first: int = 0,
    rows: str = ",".join(ROWS),
    motion: str = ",".join(hidden.MOTIONS),
    rate: str = "100",
    seed: int = SEED,
) -> None:
    """Diagnose plants.

    plants: of each row, up to this number; first: from this one on. rate: rows per second of the
    log.
    """
    every = product(
        range(first, plants), rows.split(","), motion.split(","), map(int, rate.split(","))
    )
    run([Trial(row, number, seed, moved, one_rate) for number, row, moved, one_rate in every])


if __name__ == "__main__":
    command(main)
