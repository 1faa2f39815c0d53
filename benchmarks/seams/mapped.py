"""Flights as CSV files, which a mapping reads; ``mapping.toml`` reads them as they are."""

from pathlib import Path

import numpy as np

from flytrack_sysid import import_log
from flytrack_sysid.log import CHANNELS, FlightLog

MAPPING = Path(__file__).with_name("mapping.toml").read_text(encoding="utf-8")
WRITTEN = ("u", "p", "v", "q", "w", "f", "v_bat")
TOLERANCE = 1e-4  # relative: a mapping's scales have six digits


def write_csv(path: Path, log: FlightLog) -> None:
    """Write a log's time and channels as columns with their names."""
    names = [column for channel in WRITTEN for column in CHANNELS[channel]]
    values = np.column_stack([log.time, *(log[channel] for channel in WRITTEN)])
    np.savetxt(path, values, delimiter=",", header=",".join(["t", *names]), comments="")


def import_csv(path: Path, mapping: str) -> FlightLog:
    """Return the log that a mapping, given as text, reads; its clocks stay as they are.

    The mapping is written beside the log.
    """
    file = path.with_suffix(".toml")
    file.write_text(mapping, encoding="utf-8")
    return import_log(path, "csv", file, align=False).log


def is_equal(log: FlightLog, true: FlightLog) -> bool:
    """Return whether all channels of two logs are equal, quaternions up to their sign."""
    for channel in WRITTEN:
        values = log[channel]
        if channel == "q":
            values = values * np.sign(np.sum(values * true["q"], axis=1, keepdims=True))
        size = np.linalg.norm(true[channel])
        if np.linalg.norm(values - true[channel]) > TOLERANCE * size:
            return False
    return True
