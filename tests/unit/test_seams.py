"""Flights and simulators of the benchmark; ``test_check.py`` finds each fault that they inject."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.seams.craft import GRAVITY
from benchmarks.seams.faults import FAULTS, inject
from benchmarks.seams.flight import make_flight
from tests.support.seam_flights import seam_flight


@pytest.fixture(scope="module")
def flight():
    return seam_flight("race")


def attitude(log):
    return Rotation.from_quat(log["q"], scalar_first=True)


def means(values):
    return 0.5 * (values[1:] + values[:-1])


def test_rates_and_specific_force_integrate_to_attitude_and_velocity(flight):
    truth, dt = flight.truth, flight.truth.time[1]
    q = attitude(truth)
    steps = (q[:-1].inv() * q[1:]).as_rotvec()
    assert np.abs(steps - dt * means(truth["w"])).mean() < 1e-4
    a = q.apply(truth["f"]) - [0.0, 0.0, GRAVITY]
    flown = truth["v"][0] + np.cumsum(dt * means(a), axis=0)
    assert np.abs(flown - truth["v"][1:]).max() < 0.1


def test_sensors_have_noise_of_stated_size(flight):
    for channel, least, most in (
        ("w", 0.009, 0.05),
        ("f", 0.18, 0.85),
        ("v", 0.018, 0.055),
        ("p", 0.0045, 0.0055),
        ("v_bat", 0.018, 0.022),
    ):
        noise = np.std(flight.log[channel] - flight.truth[channel], axis=0)
        assert np.all((noise > least) & (noise < most)), channel
    error = (attitude(flight.truth).inv() * attitude(flight.log)).as_rotvec()
    noise = np.rad2deg(np.std(error, axis=0))
    assert np.all((noise > 0.19) & (noise < 0.52))


def test_seeds_reproduce():
    flights = [make_flight(seed, seconds=1.0) for seed in (5, 5, 6)]
    assert flights[0].log.sha256 == flights[1].log.sha256 != flights[2].log.sha256


@pytest.mark.parametrize("name", FAULTS)
def test_fault_changes_only_its_channels(flight, name):
    truth = FAULTS[name](np.random.default_rng(1), flight.log.time[1])
    faulty = inject(np.random.default_rng(1), flight, truth)
    named = {change.channel for change in truth}
    channels = {name.removesuffix("_rates").removesuffix("_thrust") for name in named}
    changed = {name for name in flight.log.channels if np.any(faulty.log[name] != flight.log[name])}
    if not np.array_equal(faulty.motors, flight.motors):
        changed.add("motors")
    assert changed == ({*flight.log.channels, "motors"} if "rows" in channels else channels)
    if "u_rates" in named and "u_thrust" not in named:
        np.testing.assert_array_equal(faulty.log["u"][:, 3], flight.log["u"][:, 3])
    np.testing.assert_array_equal(faulty.log.time, flight.log.time)
