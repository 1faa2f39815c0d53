"""Layouts of public data sets, dry runs on synthetic files of which the truth is known."""

import numpy as np
import pytest

from benchmarks.motor_craft import Pilot, fly
from benchmarks.motors import log_of_flight
from benchmarks.published import (
    predicted,
)
from flytrack_sysid import import_log
from tests.support.motor_models import crafts
from tests.support.tables import table

CRAFTS = {name: crafts(**fields) for name, fields in table("crafts").items()}
BATTERY = 16.0


def idsia_columns(log, t):
    names = ["x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz", "wx", "wy", "wz"]
    values = np.column_stack([log["p"], log["v"], log["q"], log["w"]])
    speeds = 1750.0 * (log["u"] + 1.0)  # rear right, front right, rear left, front left
    motors = dict(zip(["m2_rads", "m1_rads", "m3_rads", "m4_rads"], speeds.T, strict=True))
    return {"t": t, **dict(zip(names, values.T, strict=True)), **motors}


def neurobem_columns(log, t):
    names = [f"{name} {axis}" for name in ("pos", "vel", "ang vel", "acc") for axis in "xyz"]
    names += ["quat w", "quat x", "quat y", "quat z", "mot 1", "mot 2", "mot 3", "mot 4"]
    speeds = 1500.0 * (log["u"] + 1.0)
    values = np.column_stack([log["p"], log["v"], log["w"], log["f"], log["q"], speeds])
    return {"t": t, **dict(zip(names, values.T, strict=True)), "vbat": np.full(len(t), BATTERY)}


LAYOUTS = {
    "idsia_nanodrone": (idsia_columns, 0.01),
    "neurobem": (neurobem_columns, 0.0025),
}


def write(folder, layout, seed, duration_s, noise):
    craft, (columns_of, dt) = CRAFTS[layout], LAYOUTS[layout]
    rng = np.random.default_rng(seed)
    flight = fly(craft, Pilot(rng, 1, duration_s, 5.0), duration_s, dt, dt / round(dt / 1.25e-3))
    log = log_of_flight(flight, 0, rng, noise)
    columns = columns_of(log, 100.0 + dt * np.arange(len(log)))
    path = folder / f"{layout}_{seed}.csv.gz"
    rows, header = np.column_stack(list(columns.values())), ",".join(columns)
    np.savetxt(path, rows, "%.9g", delimiter=",", header=header, comments="")
    return path, log


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_is_read_as_it_is_documented(layout, tmp_path):
    path, truth = write(tmp_path, layout, 0, 3.0, 0.0)
    imported = import_log(path, "csv", layout)
    log = imported.log
    assert log.has_motors and not imported.problems
    rows = np.searchsorted(LAYOUTS[layout][1] * np.arange(len(truth)), log.time + 1e-9) - 1
    for name, values in log.channels.items():
        if name in truth:
            expected, size = np.abs(truth[name][rows]), max(np.ptp(truth[name]), 1.0)
            np.testing.assert_allclose(np.abs(values), expected, atol=2e-3 * size, err_msg=name)


@pytest.mark.slow
def test_the_truth_of_a_dry_run_is_found(tmp_path):
    layout = "idsia_nanodrone"
    train, test = (
        import_log(write(tmp_path, layout, seed, length, 0.3)[0], "csv", layout)
        for seed, length in ((1, 40.0), (2, 10.0))
    )
    result = predicted(train, test)
    craft = CRAFTS[layout]
    radii = np.sqrt(np.diag(craft.inertia[0]) / craft.mass[0])
    expected = dict(zip(("radius_x", "radius_y", "radius_z"), radii, strict=True))
    expected |= {"up_s": craft.up_s[0], "down_s": craft.down_s[0]}
    for name, value in expected.items():
        interval = result.intervals[f"motors.{name}"]
        assert interval.low < value < interval.high, name
    drag = result.intervals["linear_drag.d_x"]
    assert drag.value == pytest.approx(craft.drag[0, 0] / craft.mass[0], rel=0.02)
    assert np.all(np.array(result.errors["motors"]) < 0.35 * np.array(result.errors["drifting"]))
