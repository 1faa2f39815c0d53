"""Gaps are filled with what lies in between, and what is not known of lost commands is carried along."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_sysid.log import FlightLog
from flytrack_sysid.record import PADDED_TO, WINDOW_S, fill_gaps, make_record
from flytrack_sysid.split import blocks_of
from tests.support.handout_plant import HandoutPlant, excited


def ramp(*lost: int, rows: int = 12, jump_at: int | None = None, slope: float = 0.02) -> FlightLog:
    """Return a log with evenly changing commands that turns about x, with some rows lost."""
    time = np.arange(rows) * 0.01
    u = np.outer(time / 0.01 * slope, [1.0, -1.0, 2.0, 0.0])
    if jump_at is not None:
        u[jump_at:] += 0.6
    q = Rotation.from_rotvec(np.outer(3.0 * time, [1.0, 0.0, 0.0])).as_quat(scalar_first=True)
    log = FlightLog(time, {"u": u, "q": q, "v": np.outer(time, [1.0, 2.0, 3.0])}, np.zeros(rows, int))
    return log.select(~np.isin(np.arange(rows), lost))


def joined(*logs: FlightLog) -> FlightLog:
    channels = {name: np.concatenate([log[name] for log in logs]) for name in logs[0].channels}
    lengths = [len(log) for log in logs]
    time = np.concatenate([log.time for log in logs])
    return FlightLog(time, channels, np.repeat(np.arange(len(logs)), lengths))


# What is lost: in the middle, two in a row, two gaps side by side, next to both ends of the flight.
LOST = [(5,), (5, 6), (4, 6), (1,), (10,), (1, 10), (2, 5, 8)]


@pytest.mark.parametrize("lost", LOST)
def test_lost_rows_come_back_in_between(lost):
    whole = joined(ramp(), ramp(slope=-0.03))
    filled = fill_gaps(joined(ramp(*lost), ramp(slope=-0.03)))
    np.testing.assert_allclose(filled.log.time, whole.time, atol=1e-12)
    np.testing.assert_array_equal(filled.log.segment, whole.segment)
    np.testing.assert_array_equal(np.flatnonzero(filled.source_row < 0), lost)
    for name in whole.channels:
        np.testing.assert_allclose(filled.log[name], whole[name], atol=1e-12, err_msg=name)
    np.testing.assert_allclose(filled.command_doubt, 0.0, atol=1e-12)
    assert np.all(filled.behind[np.array(lost)] < np.array(lost))


def test_doubt_is_half_the_jump_where_commands_jump():
    for lost, jump_at in (((5,), 5), ((5,), 6), ((5, 6), 6), ((10,), 11), ((1,), 1)):
        doubt = fill_gaps(ramp(*lost, jump_at=jump_at)).command_doubt
        np.testing.assert_allclose(doubt[list(lost)], 0.3, atol=1e-12)
        np.testing.assert_array_equal(np.delete(doubt, lost, axis=0), 0.0)


def test_long_gap_begins_a_new_flight_and_jitter_is_no_gap():
    log = ramp(*range(12, 23), rows=40)
    filled = fill_gaps(log)
    assert len(filled.log) == len(log) and list(np.flatnonzero(filled.log.is_start())) == [0, 12]
    assert len(fill_gaps(ramp(*range(12, 20), rows=40)).log) == 40
    time = np.arange(40) * 0.01 + np.random.default_rng(0).uniform(-0.002, 0.002, 40)
    jittered = replace(ramp(rows=40), time=time)
    np.testing.assert_array_equal(fill_gaps(jittered).log.time, time)


@pytest.mark.parametrize("lengths", [(1,), (1, 1, 30), (30, 1), (2, 3, 1024 - 5), (1025,)])
def test_record_of_flights_of_any_length(lengths):
    log = joined(*(ramp(rows=length) for length in lengths))
    record = make_record(log)
    rows = sum(lengths)
    assert len(record.step_s) == -(-rows // PADDED_TO) * PADDED_TO
    np.testing.assert_array_equal(record.source_row[:rows], np.arange(rows))
    assert np.all(record.source_row[rows:] == -1) and np.all(record.begins[rows:])
    np.testing.assert_array_equal(np.flatnonzero(record.begins[:rows]), np.cumsum((0, *lengths))[:-1])
    np.testing.assert_allclose(record.step_s, 0.01)
    assert all(np.isfinite(values).all() for values in record if values.dtype == float)


def test_windows_are_at_most_so_long_and_within_blocks():
    log = excited(HandoutPlant(), flights=24)
    one_flight = replace(log, time=np.arange(len(log)) * 0.01, segment=np.zeros(len(log), int))
    for case in (log, one_flight):
        piece, block = make_record(case).piece[: len(log)], blocks_of(case)
        assert np.all(np.isin(np.diff(piece), [0, 1]))
        for number in np.unique(piece):
            own = piece == number
            assert len(np.unique(block[own])) == 1 and np.ptp(case.time[own]) <= WINDOW_S
            assert own.sum() > 60
