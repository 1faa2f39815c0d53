"""Collecting flies any plant within its envelope or says why not; sensors add what they state."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import nominal_parameters
from flytrack_env.plants import Simulator
from flytrack_sysid import CollectError, collect, sensors
from flytrack_sysid.excitation import HEIGHTS, KINDS, MAX_SPEED
from flytrack_sysid.split import block_numbers, held_out_rows
from tests.support.handout_plant import GRAVITY, HandoutPlant, excited, states_of

NOMINAL = nominal_parameters()
SAME = HandoutPlant(NOMINAL.tau, NOMINAL.thrust_coeffs, NOMINAL.max_rate)


@pytest.mark.parametrize("plant", [SAME, Simulator()], ids=["function", "plant"])
def test_log_is_what_the_plant_did(plant):
    """Each row follows from the row before under that row's command, accelerations included."""
    reports = []
    log = collect(plant, minutes=1.0, seed=2, report=lambda *counts: reports.append(counts))
    # Of a function, one flight is flown after the other.
    assert reports == [(number + 1, 24) for number in range(24) if plant is SAME]
    rng = np.random.default_rng(0)
    assert log.origin == sensors.measure(log, 1.0, GRAVITY, rng).origin == "simulated"
    assert log.time.max() <= 2.5 and len(log) > 0.8 * 6000
    x = states_of(log)
    after = SAME(x[:-1], log["u"][:-1])
    inside = ~log.is_start()[1:]
    assert_allclose(x[1:][inside], after[inside], atol=2e-5)
    first = np.flatnonzero(log.is_start())
    assert np.abs(log["a"][first]).max() > 0.1, "the first row's acceleration is the plant's"


def test_envelope_cuts_a_plant_of_huge_thrust():
    strong = replace(HandoutPlant(), coeffs=(-24.0, -16.0, 14.0, 1.6, 3.2, 3.6))
    log = collect(strong, minutes=1.0)
    assert np.linalg.norm(log["v"], axis=1).max() <= MAX_SPEED
    assert HEIGHTS[0] <= log["p"][:, 2].min() and log["p"][:, 2].max() <= HEIGHTS[1]
    assert log["v_bat"].min() >= 22.0
    lengths = np.unique(log.segment, return_counts=True)[1]
    assert len(lengths) == 24 and lengths.min() < 250, "some flights are cut, and none is dropped"


def broken(index, value):
    """Return a step of the handout's plant with a component of the state replaced in flight."""

    def step(x, u):
        after = HandoutPlant()(x, u)
        if x[2] != 60.0:
            after[index] = value
        return after

    return step


@pytest.mark.parametrize(
    ("step", "arguments", "message"),
    [
        (replace(HandoutPlant(), coeffs=(1.0, 1.0, 0, 0, 0, 0)), {}, "sink and to climb"),
        (replace(HandoutPlant(), coeffs=(2.0 * GRAVITY, 1.0, 0, 0, 0, 0)), {}, "sink and to climb"),
        (broken(index=20, value=np.nan), {}, "found nan in component 20, flight 0 .roll., step"),
        (lambda x, u: HandoutPlant()(x, u)[:20], {}, r"shape \(20,\), expected \(21,\)"),
        (lambda x, u: x * np.nan, {}, "vertical accelerations of nan and nan"),
        (broken(index=2, value=500.0), {}, "no flight stayed within the envelope"),
        (HandoutPlant(), {"minutes": np.nan}, "minutes: found nan, expected at least 1"),
    ],
)
def test_plants_that_do_not_fly_are_refused(step, arguments, message):
    with pytest.raises(CollectError, match=message):
        collect(step, **{"minutes": 1.0, **arguments})


def test_held_out_part_has_every_kind_a_clear_step_of_each_axis_and_all_voltages():
    log = collect(HandoutPlant(), minutes=1.0, seed=1)
    out = held_out_rows(log)
    assert_array_equal(out, block_numbers(log) % 4 == 3)
    assert_array_equal(held_out_rows(log, 2), block_numbers(log) % 2 == 1)
    assert not held_out_rows(log, 0).any()
    for every in (1, -4):
        with pytest.raises(ValueError, match=f"every: found {every}"):
            held_out_rows(log, every)
    for part in (out, ~out):
        volts = log["v_bat"][part]
        assert volts.min() < 22.6 and volts.max() > 23.4
    part = log.select(out)
    kinds = np.array(KINDS)[part.segment // 4 % len(KINDS)]
    assert set(kinds) == set(KINDS)
    jumps = np.abs(np.diff(part["u"], axis=0))
    is_inside = ~part.is_start()[1:]
    for axis, stick in enumerate(("roll", "pitch", "yaw")):
        assert jumps[is_inside & (kinds[1:] == stick), axis].max() >= 0.3, stick


# --- Sensors --------------------------------------------------------------------------------------


def test_noise_is_as_stated():
    truth = excited(HandoutPlant())
    log = sensors.measure(truth, 2.0, GRAVITY, np.random.default_rng(0))
    row_ids = [
        np.round(flight.time * 100).astype(int) + 1000 * flight.segment for flight in (truth, log)
    ]
    kept = np.isin(*row_ids)
    assert set(log.channels) == {"u", "w", "f", "v", "p", "q", "v_bat"}
    assert len(log) == kept.sum() and 0.03 < 1.0 - kept.mean() < 0.05
    assert_array_equal(log["u"], truth["u"][kept])
    exact = {**truth.channels, "f": sensors.specific_force_b(truth, GRAVITY)}
    errors = {name: log[name] - exact[name][kept] for name in "wfvp"}
    quats = [Rotation.from_quat(quat, scalar_first=True) for quat in (exact["q"][kept], log["q"])]
    errors["q"] = (quats[0].inv() * quats[1]).as_rotvec()
    stated = {
        "w": sensors.GYRO_NOISE,
        "f": sensors.ACCELEROMETER_NOISE,
        "v": sensors.VELOCITY_NOISE,
        "p": sensors.POSITION_NOISE,
        "q": np.deg2rad(0.5),
    }
    for name, noise in stated.items():
        assert_allclose(errors[name].std(axis=0), 2.0 * noise, rtol=0.05, err_msg=name)
        assert np.abs(errors[name].mean(axis=0)).max() < 0.1 * noise, name
    assert_allclose(np.linalg.norm(log["q"], axis=1), 1.0, rtol=1e-12)
