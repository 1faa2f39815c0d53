"""Plants with hidden effects: equations, motion, flights and logs. A diagnosis is graded on them.

The package's continuous motion, which shares no code, converges to fine motion
(tests/unit/test_motion.py). The plants that a policy races on, in JAX, fly as those in plain
floats.
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import hidden
from benchmarks.loop.plants import EFFECTS, draw_plant_with_law
from flytrack_bench.hidden import HiddenDrone, HiddenPlant, Start, drone
from flytrack_bench.hidden.laws import STATELESS_KINDS
from flytrack_bench.hidden.noise import COLOURS, LOST_ROWS, STD
from flytrack_env import nominal_parameters
from tests.support.hidden_flights import LOW_START, flown_in_floats, random_sticks, state_of
from tests.support.simulated_flights import flown_by
from tests.support.slow import slow_but
from tests.support.tables import table

START = Start((1.0, -2.0, 6.0), 0.7, 23.8, -0.2)
LOOP_STEPS = 120
MOVING_EFFECTS = table("moving_effects")
MOCAP_LATE_MS, IMU_LATE_MS = 4, round(1e3 * MOVING_EFFECTS["imu_latency"]["latency_s"])
LATE_MS = dict.fromkeys("pvq", MOCAP_LATE_MS) | dict.fromkeys(("f", "w", "slope"), IMU_LATE_MS)
# A thousandth of the sensors' noise or less (slopes: of 140 rad/s^2, times an arm of 0.06 m).
FINE_ERRORS = {"p": 1e-4, "v": 1e-4, "q": 5e-5, "f": 1e-3, "w": 1e-3, "slope": 0.1}
MINUTE_S = 60.0
ARM = {"x": 0.03, "y": -0.02, "z": 0.01}


def base(**effects):
    return replace(hidden.draw_base(np.random.default_rng(3)), effects=effects)


def flown(truth, seconds=MINUTE_S, seed=1):
    return hidden.fly(truth, seconds, np.random.default_rng(seed))


def test_ground_effect_fades_with_the_height():
    low = START._replace(pos_w=(0.0, 0.0, 0.3))
    lifted, plain = (
        flown_in_floats(truth, random_sticks(10), low)["f"][0]
        for truth in (base(ground_effect={"gain": 0.5, "height_m": 0.3}), base())
    )
    np.testing.assert_allclose(lifted, plain * [1.0, 1.0, 1.0 + 0.5 * np.exp(-1.0)])


# Laws that the package has as well are flown against its own (tests/unit/test_effect_laws.py).
def test_an_accelerometer_off_the_centre_feels_the_turn():
    clean, moved = (flown(base(**effects), seconds=4.0) for effects in ({}, {"imu_offset": ARM}))
    arm, rates = np.array(list(ARM.values())), clean["w"][1:]
    expected = np.cross(rates, np.cross(rates, arm)) + np.cross(
        np.diff(clean["w"], axis=0) / 0.01, arm
    )
    np.testing.assert_allclose(moved["f"][1:] - clean["f"][1:], expected, atol=1e-9)
    assert np.abs(expected).max() > 0.1


@pytest.mark.parametrize("motion", hidden.MOTIONS)
def test_full_stick_saturates_in_every_motion(motion):
    lost = {"roll": 0.2, "pitch": 0.1, "yaw": 0.05}
    truth = replace(base(rate_saturation=lost), motion=motion)
    plant = HiddenDrone(truth, START, np.random.default_rng(0))
    for _ in range(200):
        plant.step((1.0, 1.0, 1.0, -0.2))
    full_rates = np.radians([618.0, 618.0, 120.0])
    np.testing.assert_allclose(plant.felt.rates_b / full_rates, [0.8, 0.9, 0.95])


@pytest.fixture(scope="module")
def clean():
    return flown(hidden.draw_base(np.random.default_rng(0)), seed=0)


def test_the_same_seed_gives_the_same_plant_and_log():
    def log(seed):
        rng = np.random.default_rng(seed)
        truth = replace(
            hidden.draw_truth(rng, 3), gust=hidden.draw_gust(rng), outside=hidden.draw_outside(rng)
        )
        return hidden.measure(hidden.fly(truth, 5.0, rng), "coloured", rng)

    assert log(1).sha256 == log(1).sha256 != log(2).sha256
    # Recorded diagnoses name plants by seed and number.
    effects = hidden.draw_truth(np.random.default_rng([2, 7]), 2).effects
    assert list(effects) == ["quadratic_drag", "rate_scale"]
    assert effects["rate_scale"]["yaw"] == pytest.approx(0.969037, abs=1e-6)


@pytest.mark.parametrize("noise", ["sensors", "heavy", "coloured"])
def test_noise_has_its_standard_deviation_tails_and_colour(noise, clean):
    logs = [hidden.measure(clean, noise, np.random.default_rng(seed)) for seed in range(8)]
    rows = [np.searchsorted(clean.time, log.time - 1e-9) for log in logs]
    assert np.mean([len(log) for log in logs]) / len(clean) == pytest.approx(
        1.0 - LOST_ROWS, abs=0.003
    )
    for name in "pvfw":
        errors = [log[name] - clean[name][kept] for log, kept in zip(logs, rows, strict=True)]
        assert np.std(np.concatenate(errors)) == pytest.approx(STD[name], rel=0.1)
    force = (logs[2]["f"] - clean["f"][rows[2]]) / STD["f"]
    far = np.mean(np.abs(force) > 5.0)
    assert far > 1e-3 if noise == "heavy" else far < 1e-3
    colours = [np.corrcoef(column[:-1], column[1:])[0, 1] for column in force.T]
    low, high = (COLOURS[0] - 0.1, COLOURS[1] + 0.05) if noise == "coloured" else (-0.1, 0.1)
    assert all(low < colour < high for colour in colours)


def test_the_accelerometer_feels_gusts():
    sticks = random_sticks(6000)
    calm = flown_in_floats(base(), sticks, START)
    for std in (0.3, 1.5):
        gust = hidden.Gust(std, 0.3, 0.05)
        seen = flown_in_floats(replace(base(), gust=gust), sticks, START)
        # Thrust has no part in body x and y.
        assert np.std(seen["f"][:, :2]) == pytest.approx(std, rel=0.15)
        assert 0.04 < np.std(seen["w"] - calm["w"]) < 0.06


def test_fine_motion_has_converged_and_late_sensors_read_the_past(monkeypatch):
    """The flight in parts of 0.1 ms, logged at 1 kHz without late sensors, is the reference."""
    late = replace(base(**MOVING_EFFECTS), motion="fine", mocap_late_s=1e-3 * MOCAP_LATE_MS)
    effects = {name: MOVING_EFFECTS[name] for name in MOVING_EFFECTS if name != "imu_latency"}
    on_time = replace(late, effects=effects, mocap_late_s=0.0, step_s=1e-3)
    sticks = random_sticks(100)
    ends = np.arange(len(sticks)) * 10 + 9  # of the steps, as rows at 1 kHz
    default_s = drone.MAX_SUBSTEP_S

    def flown_in_parts(truth, sticks, part_s):
        monkeypatch.setattr(drone, "MAX_SUBSTEP_S", part_s)
        return flown_in_floats(truth, sticks, START)

    exact = flown_in_parts(on_time, np.repeat(sticks, 10, axis=0), 1e-4)
    mean_slopes = 0.5 * (exact["slope"][1:] + exact["slope"][:-1])
    slope_errors = np.diff(exact["w"], axis=0) / on_time.step_s - mean_slopes
    assert np.median(np.abs(slope_errors)) < 0.01  # of 140; larger where a command arrives

    def errors(part_s):
        seen = flown_in_parts(late, sticks, part_s)
        assert np.abs(np.linalg.norm(seen["q"], axis=1) - 1.0).max() < 1e-12
        return {
            name: np.abs(seen[name] - exact[name][ends - LATE_MS[name]]).max()
            for name in FINE_ERRORS
        }

    coarse, halved = errors(default_s), errors(0.5 * default_s)
    assert all(coarse[name] < bound for name, bound in FINE_ERRORS.items()), coarse
    assert all(coarse[name] > 3.0 * halved[name] for name in FINE_ERRORS), (coarse, halved)


@pytest.mark.parametrize("motion", hidden.MOTIONS)
def test_late_motion_capture_and_effects_that_begin_in_the_log(motion):
    def log(truth):
        return hidden.fly(replace(truth, motion=motion), 4.0, np.random.default_rng(2))

    rng = np.random.default_rng(5)
    late, sudden = hidden.draw_late(rng), hidden.draw_onset(rng, 4.0)
    seen, clean = log(late), log(replace(late, mocap_late_s=0.0))
    rows = np.arange(10, len(clean)) - late.mocap_late_s / 0.01
    for name in "pvq":
        expected = [np.interp(rows, np.arange(len(clean)), column) for column in clean[name].T]
        np.testing.assert_allclose(seen[name][10:], np.transpose(expected), atol=2e-2)
    np.testing.assert_allclose(seen["w"], clean["w"], atol=1e-4)  # cut into other parts
    with_onset, without = log(sudden), log(replace(sudden, effects={}))
    assert sudden.onset_s is not None and 1.0 <= sudden.onset_s <= 3.0
    begun = np.abs(with_onset["f"] - without["f"]).max(axis=1) > 0.0
    assert with_onset.time[np.argmax(begun)] == pytest.approx(sudden.onset_s, abs=0.02)


def check_flight(truth, without, rng):
    """Compare both flights; that without what is tested has to differ."""
    commands = np.repeat(rng.uniform(-1.0, 1.0, (LOOP_STEPS // 4, 4)), 4, axis=0).astype(np.float32)
    expected = flown_in_floats(truth, commands)["x"]
    start = jnp.asarray(state_of(HiddenDrone(truth, LOW_START, rng)), jnp.float32)
    states = flown_by(HiddenPlant(truth), nominal_parameters(), start, commands)
    np.testing.assert_allclose(states, expected, rtol=2e-4, atol=2e-4)
    assert np.abs(expected - flown_in_floats(without, commands)["x"]).max() > 1e-3


def test_the_flight_is_that_in_plain_floats():
    rng = np.random.default_rng(len(EFFECTS))
    base = hidden.draw_base(rng)
    check_flight(hidden.with_effects(base, tuple(EFFECTS), rng), base, rng)


@pytest.mark.slow
def test_fine_motion_is_that_in_plain_floats():
    rng = np.random.default_rng(7)
    truth = replace(hidden.with_effects(hidden.draw_base(rng), ("rotor_drag",), rng), motion="fine")
    check_flight(truth, replace(truth, motion="handout"), rng)


@pytest.mark.parametrize("kind", slow_but(STATELESS_KINDS[:1], STATELESS_KINDS))
def test_a_law_outside_the_list_acts_as_in_plain_floats(kind):
    number = STATELESS_KINDS.index(kind)
    truth = draw_plant_with_law(number, seed=1)
    check_flight(truth, replace(truth, outside=None), np.random.default_rng(number))
