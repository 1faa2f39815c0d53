"""Flights of ``benchmarks.motor_craft`` as logs of motors, and as CSV files with mappings."""

import numpy as np

from benchmarks.motor_craft import Pilot, fly
from benchmarks.motors import log_of_flight
from tests.support.motor_models import crafts

MAPPING = """
[time]
step_s = 0.01
[motors]
columns = {columns}
low = 0
high = 2000
as_command = true
[frame]
mass_kg = 0.8
front_m = [0.085, 0.09]
rear_m = [0.085, 0.1]
inertia_kg_m2 = [0.004, 0.005, 0.008]
yaw_arm_m = 0.013
lag_s = [0.025, 0.04]
{frame}
[craft]
voltage_v = [23, 25]
[rates]
columns = ["w0", "w1", "w2"]
unit = "rad/s"
frame = "flu"
[specific_force]
columns = ["f0", "f1", "f2"]
unit = "m/s^2"
frame = "flu"
"""
COLUMNS = ["m0", "m1", "m2", "m3"]


def flown(craft=None, duration_s=8.0, seed=0, noise=1.0):
    """Return the log of a flight of a craft of ``crafts``."""
    craft = crafts() if craft is None else craft
    rng = np.random.default_rng(seed)
    flight = fly(craft, Pilot(rng, 1, duration_s, 6.0), duration_s, step_s=2e-3)
    return log_of_flight(flight, 0, rng, noise)


def write_csv(folder, log, columns=COLUMNS, frame=""):
    """Write a log as CSV file, and its mapping with motors in some columns; return both paths."""
    table = np.column_stack([1000.0 * (log["u"] + 1.0), log["w"], log["f"]])
    path, mapping = folder / "flight.csv", folder / "flight.toml"
    header = ",".join([*COLUMNS, "w0", "w1", "w2", "f0", "f1", "f2"])
    np.savetxt(path, table, delimiter=",", header=header, comments="")
    mapping.write_text(MAPPING.format(columns=str(columns).replace("'", '"'), frame=frame))
    return path, mapping
