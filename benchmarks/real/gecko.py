"""A Betaflight quadcopter: body rates simulated from setpoints, the second half of a flight held out."""

from pathlib import Path

import jax
import numpy as np

from benchmarks.real.black_boxes import base_steps, flown, linear_ones, posed, rows_of
from benchmarks.real.section import Record, diagnosed, imported
from benchmarks.report import table
from flytrack_sysid import FlightLog
from flytrack_sysid.diagnosis.refinement import windows_of
from flytrack_sysid.log import usual_step
from flytrack_sysid.prediction_windows import HORIZONS_S, QUANTITIES

FOLDER, FILE = "bf_gecko", "btfl_002.bbl"
MAPPING = """[rows]
every = 4

[craft]
mass_kg = 0.6  # a guess: the log does not say
"""
BEFORE_S, AFTER_S = 0.3, 0.1  # of the setpoints that the best linear law knows
RIDGE = 1e-6
HORIZON, ASKED_OVER_BASE, ASKED_OVER_ARX = "0.25", 0.8, 1.1


def measure(data: Path) -> Record:
    """Return the diagnosis, learnt from the first half, and black boxes' errors on the second."""
    found = imported(data / FOLDER / FILE, "betaflight", MAPPING)
    held_out = found.log.time > 0.5 * (found.log.time[0] + found.log.time[-1])
    diagnosis, record = diagnosed(found.log, found.nominal_model(), held_out)
    log, base = posed(found.log), diagnosis.base._replace(effects=())
    with jax.enable_x64(True):
        windows = windows_of(found.log, held_out)
        assert windows is not None
        steps, boxes = base_steps(base, log), linear_ones(rows_of(log.select(~held_out), base))
        for name, answer in boxes.items():
            rates = flown(answer, windows, steps).rms()[0, :, QUANTITIES.index("rates")]
            by_horizon = dict(zip(map("{:g}".format, HORIZONS_S), rates.round(6).tolist(), strict=True))
            record["diagnosis"]["prediction"]["errors"][name] = {"rates_rad_per_s": by_horizon}
    return record | {"best_linear_rad_per_s": best_linear(found.log, held_out)}


def best_linear(log: FlightLog, held_out: np.ndarray) -> float:
    """Return the rms error of rates, rad/s, on held-out rows of a linear law that knows later setpoints, too.

    No linear model of whatever order that is driven by the setpoints can do better but by chance.
    """
    back, ahead = (round(one / float(np.median(usual_step(log)))) for one in (BEFORE_S, AFTER_S))
    rows = np.arange(back, len(log) - ahead)
    known = log["u"][rows[:, None] + np.arange(-back, ahead + 1), :3].reshape(len(rows), -1)
    known, is_judged = np.c_[known, np.ones(len(rows))], held_out[rows]
    damping = RIDGE * np.diag(np.square(known[~is_judged]).sum(axis=0) + 1e-9)
    inner = known[~is_judged].T @ known[~is_judged] + damping
    slopes = np.linalg.solve(inner, known[~is_judged].T @ log["w"][rows[~is_judged]])
    left = log["w"][rows[is_judged]] - known[is_judged] @ slopes
    return float(np.sqrt(np.square(left).sum(axis=1).mean()))


def part(record: Record) -> str:
    """Return the asked figures, and the errors of all models."""
    errors = {
        name: one["rates_rad_per_s"] for name, one in record["diagnosis"]["prediction"]["errors"].items()
    }
    rows = [
        [name.replace("_", " "), *(f"{np.rad2deg(v):.3g}" for v in one.values())]
        for name, one in errors.items()
    ]
    own = errors["extended"][HORIZON]
    ratios = {other: own / errors[other][HORIZON] for other in ("refitted_base", "arx")}
    return "\n\n".join(
        [
            f"Gyro simulated from setpoints for {HORIZON} s on the second half, which was held out: extended "
            f"over refitted {ratios['refitted_base']:.2f} (asked: <= {ASKED_OVER_BASE}), over ARX "
            f"{ratios['arx']:.2f} (asked: <= {ASKED_OVER_ARX}).",
            "A linear law that knows the setpoints from 0.3 s before to 0.1 s after, fitted to the first, "
            f"is off by {np.rad2deg(record['best_linear_rad_per_s']):.3g} deg/s on the second: what is left "
            "beyond that does not come from the sticks, in a linear way at least.",
            table(["body rates, rms, deg/s, after", *(f"{one:g} s" for one in HORIZONS_S)], rows),
        ]
    )
