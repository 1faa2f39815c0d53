"""What a diagnosis costs, on one core: ``python -m benchmarks.diagnosis_speed``.

Flights of hidden plants of other lengths, most with two effects, are diagnosed one after the other:
in a process with an empty cache of compiled programs, in a new process with the cache that the
first one left, and the rest in that process. Compilations and traces are JAX's own counts.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from typing import Any

import jax
import numpy as np

from benchmarks import report
from benchmarks.hidden import draw_base, fly, measure
from flytrack_bench.hidden.draws import with_effects
from flytrack_env.compile_cache import keep_compiled_programs
from flytrack_sysid import FlightLog, diagnose

EVENTS = "/jax/core/compile/"
COMPILED, TRACED = EVENTS + "backend_compile_duration", EVENTS + "jaxpr_trace_duration"
CASES: tuple[tuple[float, tuple[str, ...]], ...] = (
    (60.0, ("linear_drag", "gyro_scale")),
    (40.0, ("command_delay",)),
    (25.0, ("wind", "rate_scale")),
    (50.0, ("quadratic_drag", "thrust_scale")),
    (33.0, ("imu_latency",)),
    (60.0, ("ground_effect", "thrust_tilt")),
    (45.0, ("rotor_drag", "voltage_sag")),
    (60.0, ()),
)


def make_log(seed: int, seconds: float, effects: tuple[str, ...]) -> FlightLog:
    """Return the measured log of a hidden plant with some effects."""
    rng = np.random.default_rng(seed)
    truth = with_effects(draw_base(rng), effects, rng)
    return measure(fly(truth, seconds, rng), "sensors", rng)


def measure_process(seed: int, count: int) -> None:
    """Diagnose some of the cases in this process, and print a line of JSON for each."""
    keep_compiled_programs()
    counts: Counter[str] = Counter()

    def note_event(event: str, duration_secs: float, **kwargs: str | int) -> None:
        counts.update([event])

    jax.monitoring.register_event_duration_secs_listener(note_event)
    for number, (seconds, effects) in enumerate(CASES[:count]):
        log = make_log(seed + number, seconds, effects)
        counts.clear()
        start_s = time.process_time()
        result = diagnose(log)
        line = {
            "seconds": seconds,
            "effects": list(effects),
            "named": [cause.effect for cause in (*result.causes, *result.negligible)],
            "cpu_s": time.process_time() - start_s,
            "compiled": counts[COMPILED],
            "traced": counts[TRACED],
            "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        }
        print(json.dumps(line), flush=True)


def start_process(cache: str, seed: int, count: int) -> list[dict[str, Any]]:
    """Return the lines of a new process with a folder for compiled programs."""
    code = (
        f"from benchmarks.diagnosis_speed import measure_process; measure_process({seed}, {count})"
    )
    environment = os.environ | {"XDG_CACHE_HOME": cache, "JAX_PLATFORMS": "cpu"}
    output = subprocess.run(
        [sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, check=True, text=True
    ).stdout
    return [json.loads(line) for line in output.splitlines()]


def main(seed: int = 901) -> None:
    """Measure and write docs/results/diagnosis_speed.md."""
    pinned = report.pin_to_one_core()
    with tempfile.TemporaryDirectory() as cache:
        (cold,) = start_process(cache, seed, 1)
        new, *later = start_process(cache, seed, len(CASES))
    costs = [line["cpu_s"] for line in later]
    programs = max(line["compiled"] + line["traced"] for line in later)
    figures = [
        report.Figure("60 s log, empty cache, CPU s", "45", f"{cold['cpu_s']:.0f}", 1),
        report.Figure("60 s log, new process, filled cache", "12", f"{new['cpu_s']:.0f}", 1),
        report.Figure(
            "other logs in that process, median", "5", f"{np.median(costs):.0f}", len(costs)
        ),
        report.Figure("the same, the slowest", "12", f"{max(costs):.0f}", len(costs)),
        report.Figure(
            "programs compiled and traced for another log", "0", f"{programs}", len(later)
        ),
        report.Figure("peak memory, GB", "1.0", f"{later[-1]['peak_gb']:.1f}", len(CASES)),
    ]
    header = "s of flight | hidden effects | CPU s | compiled | traced | causes named"
    rows = [
        [
            f"{line['seconds']:g}",
            ", ".join(line["effects"]) or "none",
            f"{line['cpu_s']:.0f}",
            line["compiled"],
            line["traced"],
            ", ".join(line["named"]),
        ]
        for line in (cold, new, *later)
    ]
    report.fill_page(
        report.RESULTS / "diagnosis_speed.md",
        "diagnosis_speed",
        ("scipy",),
        figures=report.figures_table(figures),
        pinned=pinned,
        table=report.table(header, rows),
    )


if __name__ == "__main__":
    report.command(main)
