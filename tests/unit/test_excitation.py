"""The excitation moves one thing at a time, over all amplitudes and voltages, the same for the same seed."""

import numpy as np
import pytest

from flytrack_sysid.collect import collect
from flytrack_sysid.excitation import AMPLITUDES, KINDS, LEG_SPEEDS, script
from flytrack_sysid.split import blocks_of, held_out_rows
from tests.support.handout_plant import HOVER, HandoutPlant

STICKS = ("roll", "pitch", "yaw", "thrust")


def test_every_kind_comes_in_fours_with_all_amplitudes_and_voltages():
    flights = script(48, HOVER, np.random.default_rng(0))
    assert [flight.kind for flight in flights] == [kind for kind in KINDS for _ in range(4)] * 2
    for kind in KINDS:
        own = [flight for flight in flights if flight.kind == kind]
        volts = np.sort([flight.start[20] for flight in own])
        assert volts[0] < 22.2 and volts[-1] == 24.0 and np.diff(volts).max() < 0.45
    for axis, kind in enumerate(KINDS[:3]):
        own = [flight.command for flight in flights if flight.kind == kind]
        assert all(np.ptp(np.delete(command, axis, axis=1), axis=0).max() == 0.0 for command in own)
        for half in np.split(np.stack(own), 2, axis=1):
            for turn in np.split(np.abs(half[..., axis]).max(axis=1), 2):
                np.testing.assert_allclose(np.sort(turn), AMPLITUDES, rtol=0.02)
    assert np.abs([flight.command for flight in flights]).max() <= 1.0
    speeds = [np.linalg.norm(flight.start[3:6]) for flight in flights if flight.kind == "leg"]
    np.testing.assert_allclose(speeds, LEG_SPEEDS * 2)


def test_held_out_part_has_every_kind_a_clear_step_of_each_axis_and_all_voltages():
    log = collect(HandoutPlant(), minutes=1.0, seed=1)
    out = held_out_rows(log)
    np.testing.assert_array_equal(out, blocks_of(log) % 4 == 3)
    np.testing.assert_array_equal(held_out_rows(log, 2), blocks_of(log) % 2 == 1)
    assert not held_out_rows(log, 0).any()
    for every in (1, -4):
        with pytest.raises(ValueError, match=f"every: found {every}"):
            held_out_rows(log, every)
    assert {KINDS[number // 4 % len(KINDS)] for number in log.segment[out]} == set(KINDS)
    for part in (out, ~out):
        volts = log["v_bat"][part]
        assert volts.min() < 22.6 and volts.max() > 23.4
    judged = log.select(out)
    same = judged.segment[1:] == judged.segment[:-1]
    for axis, stick in enumerate(STICKS[:3]):
        jumps = np.abs(np.diff(judged["u"][:, axis]))
        alone = np.array([KINDS[number // 4 % len(KINDS)] == stick for number in judged.segment[1:]])
        assert jumps[same & alone].max() >= 0.3, stick
