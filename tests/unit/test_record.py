"""Gaps are filled with what lies in between; a long one begins a new flight."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from flytrack_sysid.diagnosis import joined
from flytrack_sysid.inference.record import fill_gaps
from flytrack_sysid.log import FlightLog


def ramp(*lost, rows=12, slope=0.02):
    """Return a log with evenly changing commands that turns about x, with some rows lost."""
    time = np.arange(rows) * 0.01
    u = np.outer(time / 0.01 * slope, [1.0, -1.0, 2.0, 0.0])
    q = Rotation.from_rotvec(np.outer(3.0 * time, [1.0, 0.0, 0.0])).as_quat(scalar_first=True)
    channels = {"u": u, "q": q, "v": np.outer(time, [1.0, 2.0, 3.0])}
    return FlightLog(time, channels, np.zeros(rows, int)).select(~np.isin(np.arange(rows), lost))


# What is lost: in the middle, two in a row, two gaps side by side, next to both ends of the flight.
LOST = [(5,), (5, 6), (4, 6), (1,), (10,), (1, 10), (2, 5, 8)]


@pytest.mark.parametrize("lost", LOST)
def test_lost_rows_come_back_in_between(lost):
    whole = joined([ramp(), ramp(slope=-0.03)])
    filled = fill_gaps(joined([ramp(*lost), ramp(slope=-0.03)]))
    assert_allclose(filled.log.time, whole.time, atol=1e-12)
    assert_array_equal(filled.log.segment, whole.segment)
    assert_array_equal(np.flatnonzero(filled.source_row < 0), lost)
    for name in whole.channels:
        assert_allclose(filled.log[name], whole[name], atol=1e-12, err_msg=name)
    assert_allclose(filled.command_doubt, 0.0, atol=1e-12)
    assert np.all(filled.behind[np.array(lost)] < np.array(lost))


def test_long_gap_begins_a_new_flight_and_jitter_is_no_gap():
    log = ramp(*range(12, 23), rows=40)
    filled = fill_gaps(log)
    assert len(filled.log) == len(log) and list(np.flatnonzero(filled.log.is_start())) == [0, 12]
    assert len(fill_gaps(ramp(*range(12, 20), rows=40)).log) == 40
    time = np.arange(40) * 0.01 + np.random.default_rng(0).uniform(-0.002, 0.002, 40)
    jittered = replace(ramp(rows=40), time=time)
    assert_array_equal(fill_gaps(jittered).log.time, time)
