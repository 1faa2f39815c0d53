"""Plants with hidden effects: a diagnosis that is measured on them is only as good as they are."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.hidden import (
    EFFECTS,
    NAMES,
    Truth,
    draw_base,
    draw_effect,
    fly,
)
from benchmarks.hidden.plant import Plant, Start
from flytrack_sysid.log import FlightLog
from tests.support.handout_plant import HandoutPlant

START = Start((1.0, -2.0, 6.0), 0.7, 23.8, -0.2)
ROUNDING = 1e-12
SENSOR_EFFECTS = {
    "accelerometer_bias": {"f"},
    "accelerometer_scale": {"f"},
    "imu_offset": {"f"},
    "gyro_bias": {"w"},
    "gyro_scale": {"w"},
    "imu_latency": {"f", "w"},
}


def base() -> Truth:
    return draw_base(np.random.default_rng(3))


def commands(count: int) -> np.ndarray:
    """Return sticks that jump about, (count, 4)."""
    rng = np.random.default_rng(4)
    sticks = rng.uniform(-1.0, 1.0, (count // 10 + 1, 4)) * [0.5, 0.5, 1.0, 1.0]
    return np.repeat(sticks, 10, axis=0)[:count]


def open_loop(truth: Truth, count: int = 150, start: Start = START) -> dict[str, np.ndarray]:
    """Return channels of a plant that is flown by ``commands`` and by nobody else."""
    plant, rows = Plant(truth, start, np.random.default_rng(5)), []
    for sticks in commands(count).tolist():
        plant.step(tuple(sticks))
        rows.append((plant.pos_w, plant.vel_w, plant.quat, plant.force_b, plant.rates_b, (plant.battery_v,)))
    return dict(zip("pvqfwb", (np.array(column) for column in zip(*rows, strict=True)), strict=True))


def with_effect(name: str, **values: float) -> Truth:
    return replace(base(), effects={name: values})


def test_without_effects_it_is_the_handouts_plant() -> None:
    truth = base()
    handout = HandoutPlant(truth.tau, truth.coeffs, truth.max_rate, truth.drain)
    plant = Plant(truth, START, np.random.default_rng(0))
    state = np.concatenate(
        [plant.pos_w, plant.vel_w, plant.acc_w, plant.quat, plant.rates_b, plant.applied, [plant.battery_v]]
    )
    for sticks in commands(200):
        state = handout(state, sticks)
        plant.step(tuple(sticks.tolist()))
        own = (plant.pos_w, plant.vel_w, plant.acc_w, plant.quat, plant.rates_b, plant.applied)
        np.testing.assert_allclose(
            np.concatenate([*own, [plant.battery_v]]), state, rtol=ROUNDING, atol=ROUNDING
        )


def changed(truth: Truth) -> set[str]:
    """Return in which of force, rates and battery a plant differs that is flown as the base is."""
    start = START._replace(pos_w=(0.0, 0.0, 0.3))
    own, plain = open_loop(truth, 60, start), open_loop(base(), 60, start)
    return {name for name in ("f", "w", "b") if np.abs(own[name] - plain[name]).max() > 1e-6}


@pytest.mark.parametrize(
    ("name", "channels"),
    [
        *((name, {"w"}) for name in NAMES if name.startswith(("rate_", "second_order", "yaw_", "motor_"))),
        *((name, {"f"}) for name in ("thrust_scale", "translational_lift", "ground_effect", "thrust_tilt")),
        *((name, {"f"}) for name in ("linear_drag", "quadratic_drag", "rotor_drag", "wind")),
        ("thrust_lag_asymmetry", {"f"}),
        ("command_delay", {"f", "w"}),
        # Less voltage is less thrust.
        ("voltage_sag", {"f", "b"}),
        *((name, set()) for name in SENSOR_EFFECTS),
    ],
)
def test_each_effect_changes_its_channels_of_the_plant(name: str, channels: set[str]) -> None:
    values = draw_effect(name, np.random.default_rng(8), EFFECTS[name].high)
    assert changed(replace(base(), effects={name: values})) == channels


def test_every_effect_is_tested() -> None:
    (mark,) = test_each_effect_changes_its_channels_of_the_plant.pytestmark
    assert sorted(name for name, _ in mark.args[1]) == sorted(NAMES)


@pytest.mark.parametrize("name", SENSOR_EFFECTS)
def test_sensors_lie_about_their_channels_only(name: str) -> None:
    values = draw_effect(name, np.random.default_rng(8), EFFECTS[name].high)
    truth = replace(base(), effects={name: values})
    own, plain = (fly(of, "scripted", 4.0, np.random.default_rng(1)) for of in (truth, base()))
    different = {channel for channel in own.channels if not np.array_equal(own[channel], plain[channel])}
    assert different == SENSOR_EFFECTS[name]


def test_equations_of_the_sensors() -> None:
    truth = base()
    clean = fly(truth, "scripted", 4.0, np.random.default_rng(1))

    def seen(name: str, **values: float) -> FlightLog:
        return fly(replace(truth, effects={name: values}), "scripted", 4.0, np.random.default_rng(1))

    np.testing.assert_allclose(seen("gyro_bias", x=0.1, y=0.0, z=-0.2)["w"], clean["w"] + [0.1, 0.0, -0.2])
    np.testing.assert_allclose(seen("gyro_scale", x=1.1, y=1.0, z=0.9)["w"], clean["w"] * [1.1, 1.0, 0.9])
    late = seen("imu_latency", latency_s=0.015)
    np.testing.assert_allclose(late["f"][5:], 0.5 * (clean["f"][3:-2] + clean["f"][4:-1]))
    arm = np.array([0.03, -0.02, 0.01])
    spin = np.diff(clean["w"], axis=0) / 0.01
    rates = clean["w"][1:]
    expected = np.cross(rates, np.cross(rates, arm)) + np.cross(spin, arm)
    moved = seen("imu_offset", x=0.03, y=-0.02, z=0.01)["f"][1:] - clean["f"][1:]
    np.testing.assert_allclose(moved, expected, atol=1e-9)
    assert np.abs(expected).max() > 0.1


def test_equations_of_the_rate_loop() -> None:
    plain = open_loop(base())["w"]
    full = np.radians(base().max_rate)
    stick = plain / full
    scaled = open_loop(with_effect("rate_scale", roll=1.1, pitch=0.9, yaw=1.0))["w"]
    np.testing.assert_allclose(scaled, plain * [1.1, 0.9, 1.0])
    curved = open_loop(with_effect("rate_expo", expo=0.3))["w"]
    np.testing.assert_allclose(curved, full * (0.7 * stick + 0.3 * stick**3), atol=1e-12)
    limited = open_loop(with_effect("rate_slew_limit", inverse=0.01))["w"]
    assert np.abs(np.diff(limited, axis=0)).max() == pytest.approx(1.0)
    coupled = open_loop(with_effect("rate_cross_coupling", from_roll=0.1, from_pitch=-0.2))["w"]
    np.testing.assert_allclose(coupled[:, 2], plain @ [0.1, -0.2, 1.0])
    pushed = open_loop(with_effect("motor_imbalance", roll=0.01, pitch=-0.02))
    thrust_acc = pushed["f"][:, 2]
    np.testing.assert_allclose(pushed["w"] - plain, np.outer(thrust_acc, [0.01, -0.02, 0.0]), atol=1e-12)


def test_saturation_loses_its_share_at_full_stick() -> None:
    plant = Plant(with_effect("rate_saturation", lost=0.2), START, np.random.default_rng(0))
    for _ in range(200):
        plant.step((1.0, -1.0, 1.0, -0.2))
    np.testing.assert_allclose(plant.rates_b, np.radians([618.0, -618.0, 120.0]) * 0.8)


@pytest.mark.parametrize("zeta", [0.3, 1.6])
def test_second_order_rates_obey_their_differential_equation(zeta: float) -> None:
    """Against small explicit steps of y'' = wn^2 (omega - y) - 2 zeta wn y'."""
    natural, finer = 40.0, 2000
    plain, found = (
        open_loop(base(), 40)["w"],
        open_loop(with_effect("second_order_rates", wn=40.0, zeta=zeta), 40),
    )
    rate, slope = np.zeros(3), np.zeros(3)
    for asked, own in zip(plain, found["w"], strict=True):
        for _ in range(finer):
            bend = natural**2 * (asked - rate) - 2.0 * zeta * natural * slope
            rate, slope = rate + slope * 0.01 / finer, slope + bend * 0.01 / finer
        np.testing.assert_allclose(own, rate, atol=5e-3)


def test_delay_of_steps_and_parts_of_them() -> None:
    plain = open_loop(base())["w"]
    late = open_loop(with_effect("command_delay", delay_s=0.025))["w"]
    # Once the first command has been the delay's only memory for as long as lags last.
    both = 0.5 * (plain[:-3] + plain[1:-2])
    np.testing.assert_allclose(late[120:], both[117:], atol=1e-5)
    assert np.abs(late[120:] - plain[120:]).max() > 1.0
