import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.seams.craft import GRAVITY, MOMENT_SIGNS, STEP_S, at_rest, draw_craft, hold
from benchmarks.seams.faults import FAULTS, Change, draw_pair, inject, is_shown
from benchmarks.seams.flight import KINDS, Flight, make_flight
from benchmarks.seams.simulators import SIMULATORS, Simulator
from flytrack_sysid.log import FlightLog

SEED = 2  # at 100 Hz


@pytest.fixture(scope="module")
def flight() -> Flight:
    return make_flight(SEED, seconds=20.0, kind="race")


def attitude(log: FlightLog) -> Rotation:
    return Rotation.from_quat(log["q"][:, [1, 2, 3, 0]])


def means(values: np.ndarray) -> np.ndarray:
    return 0.5 * (values[1:] + values[:-1])


def test_rates_integrate_to_attitude(flight: Flight) -> None:
    truth, dt = flight.truth, flight.truth.time[1]
    q = attitude(truth)
    steps = (q[:-1].inv() * q[1:]).as_rotvec()
    assert np.abs(steps - dt * means(truth["w"])).mean() < 1e-4


def test_specific_force_integrates_to_velocity(flight: Flight) -> None:
    truth, dt = flight.truth, flight.truth.time[1]
    a = attitude(truth).apply(truth["f"]) - [0.0, 0.0, GRAVITY]
    flown = truth["v"][0] + np.cumsum(dt * means(a), axis=0)
    assert np.abs(flown - truth["v"][1:]).max() < 0.1


def test_velocity_integrates_to_position(flight: Flight) -> None:
    truth, dt = flight.truth, flight.truth.time[1]
    flown = truth["p"][0] + np.cumsum(dt * means(truth["v"]), axis=0)
    assert np.abs(flown - truth["p"][1:]).max() < 0.01


def test_sensors_have_noise_of_stated_size(flight: Flight) -> None:
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


@pytest.mark.parametrize("axis", range(3))
def test_rates_follow_commands_by_lag(axis: int) -> None:
    craft, calm = draw_craft(np.random.default_rng(3)), np.zeros(3)
    x = at_rest(craft, np.zeros(3), heading=0.0, used=0.0)
    u = np.array([0.0, 0.0, 0.0, craft.hover])
    u[axis] = 0.02
    missing = 0.0
    for _ in range(500):
        x = hold(craft, x, u, calm, 1)
        missing += STEP_S * (1.0 - x.w[axis] / np.deg2rad(0.02 * craft.max_rate[axis]))
    assert missing == pytest.approx(craft.lags[axis], abs=0.003)


def test_thrust_follows_command_by_lag_and_hovers() -> None:
    craft, calm = draw_craft(np.random.default_rng(3)), np.zeros(3)
    x = at_rest(craft, np.zeros(3), heading=0.0, used=50.0)
    x = hold(craft, x, np.array([0.0, 0.0, 0.0, craft.hover]), calm, 100)
    assert x.f[2] == pytest.approx(GRAVITY, rel=0.03)
    forces = [x.f[2]]
    for _ in range(300):
        x = hold(craft, x, np.array([0.0, 0.0, 0.0, craft.hover + 0.02]), calm, 1)
        forces.append(x.f[2] + craft.drag[2] * x.v[2])
    rise = np.array(forces) - forces[0]
    missing = STEP_S * np.sum(1.0 - rise / rise[-1])
    assert missing == pytest.approx(craft.lags[3], abs=0.004)


def test_motors_turn_and_lift_craft(flight: Flight) -> None:
    craft, truth = flight.craft, flight.truth
    thrusts = flight.motors * (craft.linear + (1.0 - craft.linear) * flight.motors)
    moments = thrusts @ MOMENT_SIGNS.T
    turns = np.gradient(truth["w"], truth.time, axis=0)
    for axis in range(3):
        assert np.corrcoef(moments[:, axis], turns[:, axis])[0, 1] > 0.6
    assert np.corrcoef(thrusts.sum(1), truth["f"][:, 2])[0, 1] > 0.9


def test_seeds_reproduce() -> None:
    flights = [make_flight(seed, seconds=2.0) for seed in (5, 5, 6)]
    assert flights[0].log.sha256 == flights[1].log.sha256 != flights[2].log.sha256
    assert flights[0].kind in KINDS


def test_hover_shows_little() -> None:
    hover = make_flight(SEED, seconds=5.0, kind="hover")
    assert not is_shown(hover, frozenset({Change("w", "axes", "x -y z")}))
    assert is_shown(hover, frozenset({Change("v_bat", "scale", 1000.0)}))


@pytest.mark.parametrize("name", FAULTS)
def test_fault_changes_only_its_channels(flight: Flight, name: str) -> None:
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
    assert isinstance(is_shown(flight, truth), bool)


def injected(flight: Flight, *changes: Change) -> FlightLog:
    return inject(np.random.default_rng(1), flight, frozenset(changes)).log


@pytest.mark.parametrize("channel", "uvpfw")
def test_delay_is_late(flight: Flight, channel: str) -> None:
    late = injected(flight, Change(channel, "delay", 0.03))[channel]
    expected = flight.truth[channel][:-3] + (flight.log[channel] - flight.truth[channel])[3:]
    np.testing.assert_allclose(late[3:], expected)


def test_delay_of_attitude_is_late(flight: Flight) -> None:
    late = attitude(injected(flight, Change("q", "delay", 0.03)))
    noise = (attitude(flight.truth).inv() * attitude(flight.log))[3:]
    error = (attitude(flight.truth)[:-3] * noise).inv() * late[3:]
    assert error.magnitude().max() < 1e-6


def test_frames_of_attitude(flight: Flight) -> None:
    true = attitude(flight.log).as_matrix()
    frd, ned = np.diag([1.0, -1.0, -1.0]), np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])
    body = attitude(injected(flight, Change("q", "body", "x -y -z"))).as_matrix()
    world = attitude(injected(flight, Change("q", "world", "y x -z"))).as_matrix()
    np.testing.assert_allclose(body, true @ frd, atol=1e-9)
    np.testing.assert_allclose(world, ned @ true, atol=1e-9)


def test_orders_of_quaternions_are_inverse(flight: Flight) -> None:
    written = injected(flight, Change("q", "order", "xyzw"))["q"]
    np.testing.assert_array_equal(written, flight.log["q"][:, [1, 2, 3, 0]])
    read = inject(
        np.random.default_rng(1),
        flight._replace(log=injected(flight, Change("q", "order", "xyzw"))),
        frozenset({Change("q", "order", "zwxy")}),
    )
    np.testing.assert_array_equal(read.log["q"], flight.log["q"])


def test_wrap_is_false_for_a_few_rows(flight: Flight) -> None:
    wrapped = attitude(injected(flight, Change("q", "wrapped", True)))
    turned = (wrapped * attitude(flight.log).inv()).magnitude() > 0.5
    assert 0 < turned.sum() < 0.1 * len(turned)


@pytest.mark.parametrize("curve", ["actual", "betaflight", "quick"])
def test_curves_weaken_small_sticks_only(flight: Flight, curve: str) -> None:
    stick = injected(flight, Change("u_rates", "curve", curve))["u"][:, :3]
    rates = flight.log["u"][:, :3]
    assert np.all(np.abs(stick) >= np.abs(rates) - 1e-9)
    assert np.abs(stick).max() <= 1.0


def test_pairs_have_two_faults() -> None:
    rng = np.random.default_rng(1)
    for _ in range(30):
        name, truth = draw_pair(rng, 0.01)
        assert len(name.split(", ")) == 2
        assert len(truth) >= 2


@pytest.mark.parametrize("simulator", SIMULATORS, ids=lambda simulator: simulator.name)
def test_simulators_fly_the_same_way(simulator: Simulator) -> None:
    layout, reference = simulator.layout, SIMULATORS[-1]
    assert reference.expected == frozenset()
    x = layout["x0"]
    hover = 3.0**-0.5  # of thrust-to-weight 3
    rates = np.array([0.2, -0.1, 0.3])
    signs = [1 - 2 * ("-" in axis) for axis in simulator.sticks.split()]
    u = np.append(rates * signs, hover if simulator.throttle == "0..1" else 2.0 * hover - 1.0)
    for _ in range(round(0.3 / layout["dt"])):
        x = simulator.step(x, u)
    p, v, q, w, _ = simulator._read(x)
    expected = reference.layout["x0"]
    for _ in range(30):
        expected = reference.step(expected, np.append(rates, 2.0 * hover - 1.0))
    true_p, true_v, true_q, true_w, _ = reference._read(expected)
    for values, true in ((p, true_p), (v, true_v), (w, true_w)):
        np.testing.assert_allclose(values, true, atol=0.02)
    assert (q.inv() * true_q).magnitude() < 0.02
    assert sorted(index for block in "pvqw" for index in layout[block]) == list(range(len(x) - 1))
