"""Plants with hidden effects: equations, motion, flights and logs. A diagnosis is graded on them.

Fine motion is that of SciPy's integrator on the same differential equations, and the package's
continuous motion converges to it (tests/unit/test_motion.py); the plants that a policy races on, in
JAX, fly as those in plain floats.
"""

from dataclasses import replace
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

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
STEP_S, STEPS = 0.01, 100
MOVING_EFFECTS = table("moving_effects")
DELAY_S = MOVING_EFFECTS["command_delay"]["delay_s"]
LATENCY_S, MOCAP_S = MOVING_EFFECTS["imu_latency"]["latency_s"], 0.0246
# A thousandth of the sensors' noise or less (slopes: of 140 rad/s^2, times an arm of 0.06 m).
FINE_ERRORS = {"p": 1e-4, "v": 1e-4, "q": 5e-5, "f": 1e-3, "w": 1e-3, "slope": 0.1}
MINUTE_S = 60.0
ARM = {"x": 0.03, "y": -0.02, "z": 0.01}


def base(**effects):
    return replace(hidden.draw_base(np.random.default_rng(3)), effects=effects)


def flown(truth, seconds=MINUTE_S, seed=1):
    return hidden.fly(truth, seconds, np.random.default_rng(seed))


def open_loop(truth, count=150, start=START):
    """Return what a plant does, flown by random steps of the sticks."""
    return flown_in_floats(truth, random_sticks(count), start)


def test_ground_effect_fades_with_the_height():
    low = START._replace(pos_w=(0.0, 0.0, 0.3))
    own = open_loop(base(ground_effect={"gain": 0.5, "height_m": 0.3}), 1, low)["f"]
    np.testing.assert_allclose(
        own, open_loop(base(), 1, low)["f"] * [1.0, 1.0, 1.0 + 0.5 * np.exp(-1.0)]
    )


# Laws that the package has as well are flown against its own (tests/unit/test_effect_laws.py).
def test_an_accelerometer_off_the_centre_feels_the_turn():
    clean, moved = (flown(base(**own), seconds=4.0) for own in ({}, {"imu_offset": ARM}))
    arm, rates = np.array(list(ARM.values())), clean["w"][1:]
    expected = np.cross(rates, np.cross(rates, arm)) + np.cross(
        np.diff(clean["w"], axis=0) / 0.01, arm
    )
    np.testing.assert_allclose(moved["f"][1:] - clean["f"][1:], expected, atol=1e-9)
    assert np.abs(expected).max() > 0.1


@pytest.mark.parametrize("motion", hidden.MOTIONS)
def test_a_flight_controller_shapes_the_sticks_before_the_lag(motion):
    def at_full_stick(num_steps, **effects):
        truth = replace(base(**effects), motion=motion)
        plant = HiddenDrone(truth, START, np.random.default_rng(0))
        for _ in range(num_steps):
            plant.step((1.0, 1.0, 1.0, -0.2))
        return plant

    lost = {"roll": 0.2, "pitch": 0.1, "yaw": 0.05}
    rates_b = at_full_stick(200, rate_saturation=lost).felt.rates_b
    full_rates = np.radians([618.0, 618.0, 120.0])
    np.testing.assert_allclose(rates_b / full_rates, [0.8, 0.9, 0.95])
    # The setpoint rises evenly, and the lag follows it tau later.
    slow = {"roll_s": 0.3, "pitch_s": 0.2, "yaw_s": 0.4}
    tau, times_s = np.array(base().tau[:3]), np.array(list(slow.values()))
    late_s = tau if motion == "fine" else 0.01 / np.expm1(0.01 / tau)  # a step asks for its end
    expected = (0.18 + late_s * np.expm1(-0.18 / tau)) / times_s
    applied = at_full_stick(18, rate_slew_limit=slow).applied
    np.testing.assert_allclose(applied[:3], expected, rtol=1e-4)


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
    calm = open_loop(base(), 6000)
    for std in (0.3, 1.5):
        seen = open_loop(replace(base(), gust=hidden.Gust(std, 0.3, 0.05)), 6000)
        # Thrust has no part in body x and y.
        assert np.std(seen["f"][:, :2]) == pytest.approx(std, rel=0.15)
        assert 0.04 < np.std(seen["w"] - calm["w"]) < 0.06


def derivative(own, time_s, x, stick):
    """Return dx/dt of position, velocity, attitude, lagged sticks, rates, slopes; and the force."""
    _, vel_w, quat, applied, rates, slopes = np.split(x, [3, 6, 10, 14, 17])
    change = (stick - applied) / np.array(own.tau)
    volt = START.open_v - own.drain * time_s / 60.0 - 0.8 * (0.5 + 0.5 * applied[3]) ** 2
    u = applied[3]
    thrust = np.dot(own.coeffs, [1.0, u, u * u, u**3, volt, u * volt]) / own.mass
    asked = np.radians(own.max_rate) * applied[:3]
    asked += np.array([0.01 * thrust, -0.005 * thrust, 0.05 * change[3]])
    attitude = Rotation.from_quat(quat, scalar_first=True)
    air_b = attitude.inv().apply(vel_w)
    force_b = (
        [0.0, 0.0, thrust]
        - np.array([0.3, 0.2, 0.1]) * air_b
        - 0.02 * thrust * air_b * [1.0, 1.0, 0.0]
    )
    w, axis = quat[0], quat[1:]
    spin = 0.5 * np.concatenate([[-axis @ rates], w * rates + np.cross(axis, rates)])
    damping, lag_s = np.array([0.6, 0.8, 0.5]), np.array([0.02, 0.025, 0.015])
    bend = (2.0 * damping / lag_s) ** 2 * (asked - rates - lag_s * slopes)
    acc_w = attitude.apply(force_b) - [0.0, 0.0, own.gravity]
    return np.concatenate([vel_w, acc_w, spin, change, slopes, bend]), force_b


def integrated(own):
    """Return the same from DOP853, between the times of arriving commands and sensor readings."""
    sticks, rows = random_sticks(STEPS), np.arange(STEPS + 1) * STEP_S
    felt_s, tracked_s = rows[1:] - LATENCY_S % STEP_S, rows[1:] - MOCAP_S % STEP_S
    times = np.unique(np.round([0.0, *rows, *(rows + DELAY_S), *felt_s, *tracked_s], 9))
    times = times[times <= rows[-1] + 1e-9]
    quat = [np.cos(0.35), 0.0, 0.0, np.sin(0.35)]
    x = np.concatenate(
        [START.pos_w, np.zeros(3), quat, np.zeros(3), [START.thrust_stick], np.zeros(6)]
    )
    found: dict[str, list] = {name: [] for name in FINE_ERRORS}
    for begin, end in pairwise(times):
        number = int(np.floor((0.5 * (begin + end) - DELAY_S) / STEP_S))
        acting = sticks[max(number, 0)]

        def slope(time_s, x, acting=acting):
            return derivative(own, time_s, x, acting)[0]

        x = solve_ivp(slope, (begin, end), x, "DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
        if np.abs(felt_s - end).min() < 1e-8:
            for name, value in zip(
                "fw", (derivative(own, end, x, acting)[1], x[14:17]), strict=True
            ):
                found[name].append(value)
            found["slope"].append(x[17:])
        if np.abs(tracked_s - end).min() < 1e-8:
            for name, value in zip("pvq", np.split(x[:10], [3, 6]), strict=True):
                found[name].append(value)
    return {name: np.array(values) for name, values in found.items()}


@pytest.mark.slow
def test_fine_motion_obeys_the_differential_equations(monkeypatch):
    own = replace(base(**MOVING_EFFECTS), motion="fine", mocap_late_s=MOCAP_S)
    exact = integrated(own)

    def errors():
        seen = open_loop(own, STEPS)
        assert np.abs(np.linalg.norm(seen["q"], axis=1) - 1.0).max() < 1e-12
        return {name: float(np.abs(seen[name] - values).max()) for name, values in exact.items()}

    found = errors()
    assert all(found[name] < bound for name, bound in FINE_ERRORS.items()), found
    monkeypatch.setattr(drone, "MAX_SUBSTEP_S", 0.5 * drone.MAX_SUBSTEP_S)
    halved = errors()
    assert all(found[name] > 3.0 * halved[name] for name in exact), (found, halved)


@pytest.mark.parametrize("motion", hidden.MOTIONS)
def test_late_motion_capture_and_effects_that_begin_in_the_log(motion):
    def log(own):
        return hidden.fly(replace(own, motion=motion), 4.0, np.random.default_rng(2))

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
    """Compare both flights; that without what is tested, if any, has to differ."""
    commands = np.repeat(rng.uniform(-1.0, 1.0, (LOOP_STEPS // 4, 4)), 4, axis=0).astype(np.float32)
    expected = flown_in_floats(truth, commands)["x"]
    start = jnp.asarray(state_of(HiddenDrone(truth, LOW_START, rng)), jnp.float32)
    found = flown_by(HiddenPlant(truth), nominal_parameters(), start, commands)
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-4)
    assert (
        without is None or np.abs(expected - flown_in_floats(without, commands)["x"]).max() > 1e-3
    )


@pytest.mark.parametrize("names", [(), EFFECTS])
def test_the_flight_is_that_in_plain_floats(names):
    rng = np.random.default_rng(len(names))
    base = hidden.draw_base(rng)
    truth = hidden.with_effects(base, tuple(names), rng)
    check_flight(truth, base if names else None, rng)


def test_fine_motion_is_that_in_plain_floats():
    rng = np.random.default_rng(7)
    truth = replace(hidden.with_effects(hidden.draw_base(rng), ("rotor_drag",), rng), motion="fine")
    check_flight(truth, replace(truth, motion="handout"), rng)


@pytest.mark.parametrize("kind", slow_but(STATELESS_KINDS[:1], STATELESS_KINDS))
def test_a_law_outside_the_list_acts_as_in_plain_floats(kind):
    number = STATELESS_KINDS.index(kind)
    truth = draw_plant_with_law(number, seed=1)
    check_flight(truth, replace(truth, outside=None), np.random.default_rng(number))
