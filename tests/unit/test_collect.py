"""Collecting flies any plant within its envelope or says why not; sensors add what they state."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import nominal_parameters
from flytrack_env.plants import Simulator
from flytrack_sysid import CollectError, FlightLog, collect, sensors
from flytrack_sysid.excitation import HEIGHTS, KINDS, LARGEST_SPEED
from flytrack_sysid.split import blocks_of, held_out_rows
from tests.support.handout_plant import GRAVITY, HandoutPlant, excited, rotation


def test_plant_and_function_of_the_same_equations_give_the_same_log():
    own, done = nominal_parameters(), []
    same = HandoutPlant(own.tau, own.thrust_coeffs, own.max_rate, own.battery_drain_v_per_min)
    plant = collect(Simulator(), minutes=1.0, seed=2)
    function = collect(same, minutes=1.0, seed=2, report=lambda *counts: done.append(counts))
    assert done == [(number + 1, 24) for number in range(24)]
    np.testing.assert_array_equal(plant.segment, function.segment)
    np.testing.assert_array_equal(plant.time, function.time)
    np.testing.assert_allclose(plant["u"], function["u"], atol=1e-5)
    for name, tolerance in {
        "p": 2e-3,
        "v": 2e-3,
        "a": 2e-3,
        "q": 1e-4,
        "w": 1e-3,
        "v_bat": 2e-4,
    }.items():
        np.testing.assert_allclose(plant[name], function[name], atol=tolerance, err_msg=name)
    assert plant.time.max() <= 2.5 and len(plant) > 0.8 * 6000


def test_log_is_what_the_plant_did():
    """Each row follows from the row before under that row's command, accelerations included."""
    log = collect(HandoutPlant(), minutes=1.0, seed=2)
    x = np.concatenate([log[name] for name in ("p", "v", "a", "q", "w", "uprev", "v_bat")], axis=1)
    after = HandoutPlant()(x[:-1], log["u"][:-1])
    inside = ~log.is_start()[1:]
    np.testing.assert_allclose(x[1:][inside], after[inside], atol=2e-5)
    first = np.flatnonzero(log.is_start())
    assert np.abs(log["a"][first]).max() > 0.1, "the first row's acceleration is the plant's"


def test_envelope_cuts_a_plant_of_huge_thrust():
    strong = replace(HandoutPlant(), coeffs=(-24.0, -16.0, 14.0, 1.6, 3.2, 3.6))
    log = collect(strong, minutes=1.0)
    assert np.linalg.norm(log["v"], axis=1).max() <= LARGEST_SPEED
    assert HEIGHTS[0] <= log["p"][:, 2].min() and log["p"][:, 2].max() <= HEIGHTS[1]
    assert log["v_bat"].min() >= 22.0
    lengths = np.unique(log.segment, return_counts=True)[1]
    assert len(lengths) == 24 and lengths.min() < 250, "some flights are cut, and none is dropped"


def broken(**parts):
    """Return a step function of the handout's plant with a value replaced after 0.3 s of flight."""

    def step(x, u):
        after = HandoutPlant()(x, u)
        if x[2] != 60.0:
            after[parts["where"]] = parts["value"]
        return after

    return step


def raises(x, u):
    raise RuntimeError("no link")


@pytest.mark.parametrize(
    ("step", "arguments", "message"),
    [
        (replace(HandoutPlant(), coeffs=(1.0, 1.0, 0, 0, 0, 0)), {}, "sink and to climb"),
        (replace(HandoutPlant(), coeffs=(2.0 * GRAVITY, 1.0, 0, 0, 0, 0)), {}, "sink and to climb"),
        (broken(where=20, value=np.nan), {}, "found nan in component 20, flight 0 .roll., step"),
        (lambda x, u: HandoutPlant()(x, u)[:20], {}, r"shape \(20,\), expected \(21,\)"),
        (lambda x, u: x * np.nan, {}, "vertical accelerations of nan and nan"),
        (raises, {}, "RuntimeError: no link"),
        (broken(where=2, value=500.0), {}, "no flight stayed within the envelope"),
        (HandoutPlant(), {"minutes": 0.9}, "minutes: found 0.9, expected at least 1"),
        (HandoutPlant(), {"minutes": np.nan}, "minutes: found nan"),
        (HandoutPlant(), {"noise": -1.0}, "noise: found -1.0, expected 0 or more"),
    ],
)
def test_plants_that_do_not_fly_are_refused(step, arguments, message):
    with pytest.raises(CollectError, match=message):
        collect(step, **{"minutes": 1.0, **arguments})


STICKS = ("roll", "pitch", "yaw", "thrust")


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
        alone = np.array(
            [KINDS[number // 4 % len(KINDS)] == stick for number in judged.segment[1:]]
        )
        assert jumps[same & alone].max() >= 0.3, stick


# --- Sensors --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def truth() -> FlightLog:
    return excited(HandoutPlant())


def test_noise_is_as_stated(truth):
    log = sensors.measure(truth, 2.0, GRAVITY, np.random.default_rng(0))
    keys = [np.round(one.time * 100).astype(int) + 1000 * one.segment for one in (truth, log)]
    kept = np.isin(*keys)
    assert "uprev" not in log and "a" not in log
    assert len(log) == kept.sum() and 0.03 < 1.0 - kept.mean() < 0.05
    np.testing.assert_array_equal(log["u"], truth["u"][kept])
    force = sensors.specific_force_b(truth, GRAVITY)[kept]
    stated = {
        "w": (truth["w"][kept], sensors.GYRO_NOISE),
        "f": (force, sensors.ACCELEROMETER_NOISE),
        "v": (truth["v"][kept], sensors.VELOCITY_NOISE),
        "p": (truth["p"][kept], sensors.POSITION_NOISE),
    }
    for name, (values, noise) in stated.items():
        left = log[name] - values
        np.testing.assert_allclose(left.std(axis=0), 2.0 * noise, rtol=0.05, err_msg=name)
        assert np.abs(left.mean(axis=0)).max() < 0.1 * noise, name
    turn = Rotation.from_quat(truth["q"][kept], scalar_first=True).inv() * Rotation.from_quat(
        log["q"], scalar_first=True
    )
    np.testing.assert_allclose(np.rad2deg(turn.as_rotvec()).std(axis=0), 1.0, rtol=0.05)
    np.testing.assert_allclose(np.linalg.norm(log["q"], axis=1), 1.0, rtol=1e-12)


def test_accelerometer_measures_what_is_not_gravity_in_the_attitude_before(truth):
    force = sensors.specific_force_b(truth, GRAVITY)
    before = rotation(truth["q"][:-1])
    expected = np.einsum("nji,nj->ni", before, truth["a"][1:] + np.array([0.0, 0.0, GRAVITY]))
    inside = ~truth.is_start()[1:]
    np.testing.assert_allclose(force[1:][inside], expected[inside], atol=1e-12)
    np.testing.assert_allclose(
        force[1:][inside][:, :2], 0.0, atol=1e-9
    )  # without drag, thrust alone
