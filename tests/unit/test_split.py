"""Blocks are flights, or even pieces of long ones; the last of every few is held out."""

import numpy as np
import pytest

from flytrack_sysid.log import FlightLog
from flytrack_sysid.split import blocks_of, held_out_rows


def log_of(*durations_s: float) -> FlightLog:
    """Return a log of flights that last so long; one row for 0."""
    lengths = [round(duration / 0.01) + 1 for duration in durations_s]
    time = np.concatenate([np.arange(length) * 0.01 for length in lengths])
    return FlightLog(time, {"u": np.zeros((len(time), 4))}, np.repeat(np.arange(len(lengths)), lengths))


def test_every_fourth_block_is_held_out_and_nothing_for_0():
    log = log_of(60.0, 2.0, 2.0)
    np.testing.assert_array_equal(held_out_rows(log), blocks_of(log) % 4 == 3)
    np.testing.assert_array_equal(held_out_rows(log, 2), blocks_of(log) % 2 == 1)
    assert not held_out_rows(log, 0).any()
    for every in (1, -4):
        with pytest.raises(ValueError, match=f"every: found {every}"):
            held_out_rows(log, every)
