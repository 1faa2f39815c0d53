"""Blocks are flights, or even pieces of long ones; the last of every few is held out."""

import numpy as np
import pytest

from flytrack_sysid.log import FlightLog
from flytrack_sysid.split import blocks_of, held_out_rows


def log_of(*durations_s: float, step_s: float = 0.01) -> FlightLog:
    """Return a log of flights that last so long; one row for 0."""
    lengths = [round(duration / step_s) + 1 for duration in durations_s]
    time = np.concatenate([np.arange(length) * step_s for length in lengths])
    return FlightLog(time, {"u": np.zeros((len(time), 4))}, np.repeat(np.arange(len(lengths)), lengths))


@pytest.mark.parametrize(
    ("durations_s", "expected"),
    [
        ([2.5] * 24, [1] * 24),  # short flights are a block each
        ([60.0], [12]),  # of 5 s at most
        ([8.0], [8]),  # of an eighth of the log at most
        ([12.0, 1.0, 30.0, 4.9], [3, 1, 6, 1]),
        ([20.0, 0.0, 0.0, 20.0], [4, 1, 1, 4]),  # flights of one row
        ([0.0, 0.0], [1, 1]),
    ],
)
def test_blocks(durations_s, expected):
    log = log_of(*durations_s)
    blocks = blocks_of(log)
    assert np.all(np.isin(np.diff(blocks), [0, 1])) and blocks[0] == 0
    found = [len(np.unique(blocks[log.segment == number])) for number in range(len(durations_s))]
    assert found == expected
    assert not set(blocks[log.segment == 0]) & set(blocks[log.segment == 1])
    for number, pieces in enumerate(expected):
        sizes = np.unique(blocks[log.segment == number], return_counts=True)[1]
        assert np.ptp(sizes) <= 2, f"flight {number} is not cut evenly into {pieces}"


def test_every_fourth_block_is_held_out_and_nothing_for_0():
    log = log_of(60.0, 2.0, 2.0)
    np.testing.assert_array_equal(held_out_rows(log), blocks_of(log) % 4 == 3)
    np.testing.assert_array_equal(held_out_rows(log, 2), blocks_of(log) % 2 == 1)
    assert not held_out_rows(log, 0).any()
    for every in (1, -4):
        with pytest.raises(ValueError, match=f"every: found {every}"):
            held_out_rows(log, every)
