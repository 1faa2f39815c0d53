"""Plants with hidden effects: their equations, flights and logs. A diagnosis is graded on them."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import hidden
from benchmarks.hidden.noise import COLOURS, LOST_ROWS, STD
from benchmarks.hidden.plant import Plant, Start
from flytrack_sysid.log import FlightLog
from tests.support.handout_plant import HandoutPlant

START = Start((1.0, -2.0, 6.0), 0.7, 23.8, -0.2)
MINUTE_S = 60.0
# Effect -> what it changes of the plant: force f, rates w, battery b; effects of sensors change nothing.
RATE_EFFECTS = [name for name in hidden.NAMES if name.startswith(("rate_", "second_", "yaw_", "motor_"))]
SENSOR_EFFECTS = [name for name in hidden.NAMES if name.startswith(("accelerometer_", "gyro_", "imu_"))]
PLANT_EFFECTS = dict.fromkeys(hidden.NAMES, "f") | dict.fromkeys(SENSOR_EFFECTS, "")
PLANT_EFFECTS |= dict.fromkeys(RATE_EFFECTS, "w") | {"command_delay": "fw", "voltage_sag": "fb"}


def base(**effects: dict[str, float]) -> hidden.Truth:
    return replace(hidden.draw_base(np.random.default_rng(3)), effects=effects)


def flown(truth: hidden.Truth, kind: str = "scripted", seconds: float = MINUTE_S, seed: int = 1) -> FlightLog:
    return hidden.fly(truth, kind, seconds, np.random.default_rng(seed))


def state_of(plant: Plant) -> np.ndarray:
    """Return the handout's vector (21,) of a plant."""
    own = (plant.pos_w, plant.vel_w, plant.acc_w, plant.quat, plant.rates_b, plant.applied)
    return np.concatenate([*own, [plant.battery_v]])


def open_loop(truth: hidden.Truth, count: int = 150, start: Start = START) -> dict[str, np.ndarray]:
    """Return channels of a plant flown by random steps of the sticks."""
    sticks = np.random.default_rng(4).uniform(-1.0, 1.0, (16, 4)) * [0.5, 0.5, 1.0, 1.0]
    plant, rows = Plant(truth, start, np.random.default_rng(5)), []
    for command in np.repeat(sticks, 10, axis=0)[:count].tolist():
        plant.step(tuple(command))
        rows.append((state_of(plant), plant.force_b, plant.rates_b, plant.battery_v))
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return dict(zip("xfwb", columns, strict=True)) | {"u": np.repeat(sticks, 10, axis=0)[:count]}


def test_without_effects_it_is_the_handouts_plant() -> None:
    truth = base()
    handout, found = HandoutPlant(truth.tau, truth.coeffs, truth.max_rate, truth.drain), open_loop(truth)
    state = state_of(Plant(truth, START, np.random.default_rng(0)))
    for sticks, own in zip(found["u"], found["x"], strict=True):
        state = handout(state, sticks)
        np.testing.assert_allclose(own, state, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", hidden.NAMES)
def test_each_effect_changes_its_channels_of_the_plant(name: str) -> None:
    values = hidden.draw_effect(name, np.random.default_rng(8), hidden.EFFECTS[name].high)
    low = START._replace(pos_w=(0.0, 0.0, 0.3))
    own, plain = open_loop(base(**{name: values}), 60, low), open_loop(base(), 60, low)
    assert {key for key in "fwb" if np.abs(own[key] - plain[key]).max() > 1e-6} == set(
        PLANT_EFFECTS.get(name, "")
    )


def test_equations_of_the_sensors() -> None:
    clean = flown(base(), seconds=4.0)

    def seen(name: str, **values: float) -> FlightLog:
        return flown(base(**{name: values}), seconds=4.0)

    np.testing.assert_allclose(seen("gyro_bias", x=0.1, y=0.0, z=-0.2)["w"], clean["w"] + [0.1, 0.0, -0.2])
    np.testing.assert_allclose(seen("gyro_scale", x=1.1, y=1.0, z=0.9)["w"], clean["w"] * [1.1, 1.0, 0.9])
    late = seen("imu_latency", latency_s=0.015)
    np.testing.assert_allclose(late["f"][5:], 0.5 * (clean["f"][3:-2] + clean["f"][4:-1]))
    arm, rates = np.array([0.03, -0.02, 0.01]), clean["w"][1:]
    expected = np.cross(rates, np.cross(rates, arm)) + np.cross(np.diff(clean["w"], axis=0) / 0.01, arm)
    moved = seen("imu_offset", x=0.03, y=-0.02, z=0.01)["f"][1:] - clean["f"][1:]
    np.testing.assert_allclose(moved, expected, atol=1e-9)
    assert np.abs(expected).max() > 0.1


def test_equations_of_the_rate_loop() -> None:
    plain = open_loop(base())["w"]
    scaled = open_loop(base(rate_scale={"roll": 1.1, "pitch": 0.9, "yaw": 1.0}))["w"]
    np.testing.assert_allclose(scaled, plain * [1.1, 0.9, 1.0])
    coupled = open_loop(base(rate_cross_coupling={"from_roll": 0.1, "from_pitch": -0.2}))["w"]
    np.testing.assert_allclose(coupled[:, 2], plain @ [0.1, -0.2, 1.0])
    pushed = open_loop(base(motor_imbalance={"roll": 0.01, "pitch": -0.02}))
    expected = np.outer(pushed["f"][:, 2], [0.01, -0.02, 0.0])
    np.testing.assert_allclose(pushed["w"] - plain, expected, atol=1e-12)
    # Delayed by two and a half steps, once the lags have settled.
    late = open_loop(base(command_delay={"delay_s": 0.025}))["w"]
    np.testing.assert_allclose(late[120:], 0.5 * (plain[:-3] + plain[1:-2])[117:], atol=1e-5)


@pytest.mark.parametrize("motion", hidden.MOTIONS)
def test_a_flight_controller_shapes_the_sticks_before_the_lag(motion: str) -> None:
    def settled(stick: float, **effects: dict[str, float]) -> np.ndarray:
        plant = Plant(replace(base(**effects), motion=motion), START, np.random.default_rng(0))
        for _ in range(200):
            plant.step((stick, -stick, stick, -0.2))
        return plant.felt.rates_b / np.radians([618.0, -618.0, 120.0])

    lost = {"roll": 0.2, "pitch": 0.1, "yaw": 0.05}
    np.testing.assert_allclose(settled(1.0, rate_saturation=lost), [0.8, 0.9, 0.95])
    np.testing.assert_allclose(settled(0.5, rate_expo=lost), 0.5 - 0.375 * np.array([0.2, 0.1, 0.05]))
    # Of a step by the whole stick: the setpoint rises evenly, and the lag follows it tau later.
    slow = {"roll_s": 0.3, "pitch_s": 0.2, "yaw_s": 0.4}
    plant = Plant(replace(base(rate_slew_limit=slow), motion=motion), START, np.random.default_rng(0))
    for _ in range(18):
        plant.step((1.0, 1.0, 1.0, -0.2))
    tau, times_s = np.array(base().tau[:3]), np.array(list(slow.values()))
    late_s = tau if motion == "fine" else 0.01 / np.expm1(0.01 / tau)  # a step asks for its end
    expected = (0.18 + late_s * np.expm1(-0.18 / tau)) / times_s
    np.testing.assert_allclose(plant.applied[:3], expected, rtol=1e-4)


@pytest.fixture(scope="module")
def clean() -> FlightLog:
    return flown(hidden.draw_base(np.random.default_rng(0)), seed=0)


def test_the_same_seed_gives_the_same_plant_and_log() -> None:
    def log(seed: int) -> FlightLog:
        rng = np.random.default_rng(seed)
        truth = replace(
            hidden.draw_truth(rng, 3), gust=hidden.draw_gust(rng), outside=hidden.draw_outside(rng)
        )
        return hidden.measure(hidden.fly(truth, "scripted", 5.0, rng), "coloured", rng)

    assert log(1).sha256 == log(1).sha256 != log(2).sha256
    # Recorded diagnoses name plants by seed and number.
    effects = hidden.draw_truth(np.random.default_rng([2, 7]), 2).effects
    assert list(effects) == ["quadratic_drag", "rate_scale"]
    assert effects["rate_scale"]["yaw"] == pytest.approx(0.969037, abs=1e-6)


@pytest.mark.parametrize("noise", ["sensors", "heavy", "coloured"])
def test_noise_has_its_standard_deviation_tails_and_colour(noise: str, clean: FlightLog) -> None:
    logs = [hidden.measure(clean, noise, np.random.default_rng(seed)) for seed in range(8)]
    rows = [np.searchsorted(clean.time, log.time - 1e-9) for log in logs]
    assert np.mean([len(log) for log in logs]) / len(clean) == pytest.approx(1.0 - LOST_ROWS, abs=0.003)
    for name in "pvfw":
        errors = [log[name] - clean[name][kept] for log, kept in zip(logs, rows, strict=True)]
        assert np.std(np.concatenate(errors)) == pytest.approx(STD[name], rel=0.1)
    force = (logs[2]["f"] - clean["f"][rows[2]]) / STD["f"]
    far = np.mean(np.abs(force) > 5.0)
    assert far > 1e-3 if noise == "heavy" else far < 1e-3
    colours = [np.corrcoef(column[:-1], column[1:])[0, 1] for column in force.T]
    low, high = (COLOURS[0] - 0.1, COLOURS[1] + 0.05) if noise == "coloured" else (-0.1, 0.1)
    assert all(low < colour < high for colour in colours)


def test_the_accelerometer_feels_gusts() -> None:
    for std in (0.3, 1.5):
        log = flown(replace(base(), gust=hidden.Gust(std, 0.3, 0.05)), "hover")
        # The pilot fights them with thrust, which has no part in body x and y.
        assert np.std(log["f"][:, :2]) == pytest.approx(std, rel=0.15)
        assert 0.04 < np.std(log["w"][:, 2]) < 0.08
