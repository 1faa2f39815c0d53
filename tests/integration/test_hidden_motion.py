"""The hidden plants' fine motion against SciPy's integrator on the same differential equations."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from benchmarks.hidden import MOTIONS, Truth, draw_base, draw_late, draw_onset, fly, plant
from benchmarks.hidden.plant import Plant, Start
from flytrack_sysid.log import FlightLog

START = Start((1.0, -2.0, 6.0), 0.7, 23.8, -0.2)
STEP_S, STEPS = 0.01, 100
DELAY_S, LATENCY_S, MOCAP_S = 0.0137, 0.0032, 0.0246
EFFECTS = {
    "command_delay": {"delay_s": DELAY_S},
    "second_order_rates": {
        **{"roll_s": 0.02, "pitch_s": 0.025, "yaw_s": 0.015},
        **{"roll_damping": 0.6, "pitch_damping": 0.8, "yaw_damping": 0.5},
    },
    "yaw_reaction": {"angle": 0.05},
    "motor_imbalance": {"roll": 0.01, "pitch": -0.005},
    "voltage_sag": {"at_full_v": 0.8},
    "linear_drag": {"d_x": 0.3, "d_y": 0.2, "d_z": 0.1},
    "rotor_drag": {"h": 0.02},
    "imu_latency": {"latency_s": LATENCY_S},
}
COLUMNS = {"p": 3, "v": 3, "q": 4, "f": 3, "w": 3, "slope": 3}


def truth(**effects: dict[str, float]) -> Truth:
    return replace(draw_base(np.random.default_rng(3)), motion="fine", effects=effects)


def commands() -> np.ndarray:
    sticks = np.random.default_rng(4).uniform(-1.0, 1.0, (STEPS // 10, 4)) * [0.5, 0.5, 1.0, 1.0]
    return np.repeat(sticks, 10, axis=0)


def flown(own: Truth) -> dict[str, np.ndarray]:
    """Return what the plant's sensors say at the end of each step."""
    drone, rows = Plant(own, START, np.random.default_rng(0)), []
    for sticks in commands().tolist():
        drone.step(tuple(sticks))
        rows.append(np.concatenate([*drone.tracked, *drone.felt]))
    parts = np.split(np.array(rows), np.cumsum(list(COLUMNS.values()))[:-1], axis=1)
    return dict(zip(COLUMNS, parts, strict=True))


def derivative(own: Truth, time_s: float, x: np.ndarray, stick: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return dx/dt of position, velocity, attitude, lagged sticks, rates and their slopes; and the force."""
    _, vel_w, quat, applied, rates, slopes = np.split(x, [3, 6, 10, 14, 17])
    change = (stick - applied) / np.array(own.tau)
    volt = START.open_v - own.drain * time_s / 60.0 - 0.8 * (0.5 + 0.5 * applied[3]) ** 2
    u = applied[3]
    thrust = np.dot(own.coeffs, [1.0, u, u * u, u**3, volt, u * volt]) / own.mass
    asked = np.radians(own.max_rate) * applied[:3]
    asked += np.array([0.01 * thrust, -0.005 * thrust, 0.05 * change[3]])
    attitude = Rotation.from_quat(quat, scalar_first=True)
    air_b = attitude.inv().apply(vel_w)
    force_b = [0.0, 0.0, thrust] - np.array([0.3, 0.2, 0.1]) * air_b - 0.02 * thrust * air_b * [1.0, 1.0, 0.0]
    w, axis = quat[0], quat[1:]
    spin = 0.5 * np.concatenate([[-axis @ rates], w * rates + np.cross(axis, rates)])
    damping, lag_s = np.array([0.6, 0.8, 0.5]), np.array([0.02, 0.025, 0.015])
    bend = (2.0 * damping / lag_s) ** 2 * (asked - rates - lag_s * slopes)
    acc_w = attitude.apply(force_b) - [0.0, 0.0, own.gravity]
    return np.concatenate([vel_w, acc_w, spin, change, slopes, bend]), force_b


def integrated(own: Truth) -> dict[str, np.ndarray]:
    """Return the same from DOP853, between the instants at which a command arrives or a sensor reads."""
    sticks, rows = commands(), np.arange(STEPS + 1) * STEP_S
    felt_s, tracked_s = rows[1:] - LATENCY_S % STEP_S, rows[1:] - MOCAP_S % STEP_S
    times = np.unique(np.round([0.0, *rows, *(rows + DELAY_S), *felt_s, *tracked_s], 9))
    times = times[times <= rows[-1] + 1e-9]
    quat = [np.cos(0.35), 0.0, 0.0, np.sin(0.35)]
    x = np.concatenate([START.pos_w, np.zeros(3), quat, np.zeros(3), [START.thrust_stick], np.zeros(6)])
    found: dict[str, list] = {name: [] for name in COLUMNS}
    for begin, end in pairwise(times):
        number = int(np.floor((0.5 * (begin + end) - DELAY_S) / STEP_S))
        acting = sticks[max(number, 0)]

        def slope(time_s: float, x: np.ndarray, acting: np.ndarray = acting) -> np.ndarray:
            return derivative(own, time_s, x, acting)[0]

        x = solve_ivp(slope, (begin, end), x, "DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
        if np.abs(felt_s - end).min() < 1e-8:
            for name, value in zip("fw", (derivative(own, end, x, acting)[1], x[14:17]), strict=True):
                found[name].append(value)
            found["slope"].append(x[17:])
        if np.abs(tracked_s - end).min() < 1e-8:
            for name, value in zip("pvq", np.split(x[:10], [3, 6]), strict=True):
                found[name].append(value)
    return {name: np.array(values) for name, values in found.items()}


def test_fine_motion_obeys_the_differential_equations(monkeypatch: pytest.MonkeyPatch) -> None:
    own = replace(truth(**EFFECTS), mocap_late_s=MOCAP_S)
    exact = integrated(own)

    def errors() -> dict[str, float]:
        return {name: float(np.abs(values - exact[name]).max()) for name, values in flown(own).items()}

    found = errors()
    assert np.abs(np.linalg.norm(flown(own)["q"], axis=1) - 1.0).max() < 1e-12
    # A thousandth of the sensors' noise or less (slopes: of 140 rad/s^2, times an arm of 0.06 m).
    most = {"p": 1e-4, "v": 1e-4, "q": 5e-5, "f": 1e-3, "w": 1e-3, "slope": 0.1}
    assert all(found[name] < bound for name, bound in most.items()), found
    monkeypatch.setattr(plant, "LONGEST_PART_S", 0.5 * plant.LONGEST_PART_S)
    halved = errors()
    assert all(found[name] > 3.0 * halved[name] for name in COLUMNS), (found, halved)


@pytest.mark.parametrize("motion", MOTIONS)
def test_late_motion_capture_and_effects_that_begin_in_the_log(motion: str) -> None:
    def log(own: Truth) -> FlightLog:
        return fly(replace(own, motion=motion), "scripted", 4.0, np.random.default_rng(2))

    rng = np.random.default_rng(5)
    late, sudden = draw_late(rng), draw_onset(rng, 4.0)
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
