"""Effects: the contract over the whole list, then what each of them does."""

from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_env import effects
from flytrack_env.dynamics import ModelParameters, nominal_parameters, read_sensors, start_rates, step
from flytrack_env.effects import (
    EFFECTS,
    CommandDelay,
    Effect,
    LinearDrag,
    QuadraticDrag,
    RateScale,
    RotorDrag,
    ThrustScale,
    Wind,
    check_parameters,
)
from flytrack_env.effects.command_delay import BUFFER_STEPS
from flytrack_env.env import FlyTrack
from flytrack_env.plants import Simulator
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.state import Action, Drone, pack, unpack_action

DT = 0.01
NOMINAL = nominal_parameters()
SIMULATOR = Simulator()
GRAVITY = np.array([0.0, 0.0, 9.80665])
NO_THRUST = NOMINAL._replace(thrust_coeffs=np.zeros(6, np.float32))
OVER_EFFECTS = pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)


def moving_drone(rng: np.random.Generator) -> Drone:
    """Return a drone in a random attitude, fast, with sticks off centre."""
    quat = Rotation.random(rng=rng).as_quat(scalar_first=True)
    drone = Drone(
        pos_w=Vec3(*rng.normal(np.array([0.0, 0.0, 5.0]))),  # above the ground
        vel_w=Vec3(*rng.normal(size=3) * 8.0),
        acc_w=Vec3(0.0, 0.0, 0.0),
        quat=Quaternion(*quat),
        rates_b=Vec3(0.0, 0.0, 0.0),
        applied=Action(*rng.uniform(-0.8, 0.8, 4)),
        battery_v=23.2,
    )
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), drone)


@jax.jit
def fly(drone: Drone, commands: jax.Array, model: ModelParameters) -> jax.Array:
    """Return the packed states after each command, gyro and accelerometer behind them, (num_steps, 27)."""

    def one(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
        after = SIMULATOR.step(state, unpack_action(action), DT, model)
        reading = read_sensors(state.drone, after.drone, after.memories, DT, model)
        return after, jnp.concatenate([pack(after.drone), jnp.stack([*reading.rates_b, *reading.force_b])])

    return jax.lax.scan(one, SIMULATOR.reset(drone, model), commands)[1]


def random_flight(effect_parameters: Any, seed: int = 0, num_steps: int = 30) -> np.ndarray:
    """Return a flight of random commands on the nominal model with some effects."""
    rng = np.random.default_rng(seed)
    commands = rng.uniform(-1.0, 1.0, (num_steps, 4)).astype(np.float32)
    return np.asarray(fly(moving_drone(rng), commands, NOMINAL.with_effects(*effect_parameters)))


def inside_ranges(effect: Effect, fraction: float) -> Any:
    """Return parameters that lie that far from neutral towards the upper end of their ranges."""
    neutral = effect.parameters()
    values = (n + fraction * (r.high - n) for n, r in zip(neutral, effect.ranges.values(), strict=True))
    return effect.parameters(*values)


# --- The contract ---------------------------------------------------------------------------------


@OVER_EFFECTS
@pytest.mark.parametrize("seed", range(3))
def test_neutral_equals_absent_bit_for_bit(effect: Effect, seed: int) -> None:
    np.testing.assert_array_equal(random_flight([effect.parameters()], seed), random_flight([], seed))


def test_all_neutral_together_equal_absent() -> None:
    neutral = [effect.parameters() for effect in EFFECTS]
    np.testing.assert_array_equal(random_flight(neutral), random_flight([]))


@OVER_EFFECTS
def test_says_what_it_is(effect: Effect) -> None:
    assert tuple(effect.ranges) == effect.parameters._fields
    for name, neutral in effect.parameters()._asdict().items():
        bounds = effect.ranges[name]
        assert bounds.low <= neutral <= bounds.high and bounds.low < bounds.high and bounds.unit
    assert effect.stages and effect.equation and effect.source
    assert (effect.start is None) == (effect.remember is None)
    for name, values in effect.probes.items():
        assert all(effect.ranges[name].low <= value <= effect.ranges[name].high for value in values)


@OVER_EFFECTS
def test_probes_show_the_effect(effect: Effect) -> None:
    drone, full_stick = moving_drone(np.random.default_rng(0)), jnp.ones((20, 4))
    for name, values in effect.probes.items():
        for value in values:
            probed = NOMINAL.with_effects(effect.parameters()._replace(**{name: value}))
            assert not np.array_equal(fly(drone, full_stick, probed), fly(drone, full_stick, NOMINAL))


# Components of the state and of the sensors' readings after one step that an effect at this stage may change.
GYRO, ACCELEROMETER = {*range(21, 24)}, {*range(24, 27)}
FORCE = {*range(0, 9)} | ACCELEROMETER
CHANGES = {"command": set(range(27)) - {20}, "rates": {*range(9, 16)} | GYRO, "thrust": FORCE, "air": FORCE}
CHANGES |= {"lag": CHANGES["command"], "force": FORCE, "battery": {20}}
CHANGES |= {"gyro": GYRO, "accelerometer": ACCELEROMETER}


@OVER_EFFECTS
def test_changes_what_it_says_and_nothing_else(effect: Effect) -> None:
    with_effect = random_flight([inside_ranges(effect, 0.8)], num_steps=1)
    changed = set(np.flatnonzero((with_effect != random_flight([], num_steps=1)).any(axis=0)))
    allowed = set().union(*(CHANGES[stage] for stage in effect.stages))
    assert changed, "nothing changes; moving air does nothing without drag: it takes another hook"
    assert changed <= allowed


SENSOR_EFFECTS = [effect for effect in EFFECTS if effect.acts_on == ("sensor",)]


def test_sensor_effects_change_readings_and_never_the_flight() -> None:
    assert len(SENSOR_EFFECTS) == sum("sensor" in effect.acts_on for effect in EFFECTS) > 0
    sensing = random_flight([inside_ranges(effect, 0.8) for effect in SENSOR_EFFECTS])
    np.testing.assert_array_equal(sensing[:, :21], random_flight([])[:, :21])
    assert (sensing[:, 21:] != random_flight([])[:, 21:]).all(axis=0).all()


@OVER_EFFECTS
def test_gradients_are_finite_and_right(effect: Effect) -> None:
    rng = np.random.default_rng(1)
    drone, commands = moving_drone(rng), jnp.asarray(rng.uniform(-0.9, 0.9, (6, 4)), jnp.float32)

    @jax.jit
    def final(parameters: Any) -> jax.Array:
        # With some drag: without any, moving air does nothing.
        return fly(drone, commands, NOMINAL.with_effects(LinearDrag(0.1, 0.1, 0.1), parameters))[-1]

    gradient = jax.jit(jax.jacfwd(final))
    for fraction in (0.0, 0.8):
        parameters = jax.tree.map(jnp.float32, inside_ranges(effect, fraction))
        slopes = gradient(parameters)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))
        for name, bounds in effect.ranges.items():
            if fraction == 0.0 and effect.probes:
                continue  # no slope there, or not the same on both sides
            if fraction == 0.0 and name in effect.shapes:
                assert not np.asarray(getattr(slopes, name)).any()
                continue
            change = 2e-3 * (bounds.high - bounds.low)
            there = final(parameters._replace(**{name: getattr(parameters, name) + change}))
            slope = np.asarray(getattr(slopes, name))
            measured = np.asarray(there - final(parameters)) / change
            assert np.abs(slope).max() > 0.0
            np.testing.assert_allclose(slope, measured, atol=0.03 * np.abs(slope).max() + 1e-4 / change)


@OVER_EFFECTS
def test_one_kind_of_model_is_one_tree(effect: Effect) -> None:
    with_effect = NOMINAL.with_effects(inside_ranges(effect, 0.3))
    assert jax.tree.structure(with_effect) == jax.tree.structure(NOMINAL.with_effects(effect.parameters()))
    assert jax.tree.structure(with_effect) != jax.tree.structure(NOMINAL)
    assert len(jax.tree.leaves(with_effect)) == len(jax.tree.leaves(NOMINAL)) + len(effect.ranges)


def test_tree_definitions_are_pairwise_distinct() -> None:
    trees = [jax.tree.structure(effect.parameters()) for effect in EFFECTS]
    assert all(a != b for a, b in combinations(trees, 2))
    names = [effect.name for effect in EFFECTS]
    assert len(set(names)) == len(names) and set(effects.BY_NAME) == set(names)


def test_every_file_of_the_folder_is_in_the_list() -> None:
    folder = effects.__path__[0]

    files = {path.stem for path in Path(folder).glob("*.py")} - {"__init__", "base"}
    assert files == {effect.name for effect in EFFECTS}


def test_parameters_beyond_what_the_effect_can_do_are_refused() -> None:
    check_parameters(CommandDelay(0.04), 0.01)
    for delay_s, dt, expected in (
        (0.05, 0.01, "0 to 0.04 s"),
        (0.03, 0.005, "0 to 0.02 s at steps of 0.005 s"),
    ):
        with pytest.raises(ValueError, match=f"command_delay.delay_s: found {delay_s}, expected {expected}"):
            check_parameters(CommandDelay(delay_s), dt)


def test_starts_have_the_rates_that_the_model_gives_their_sticks() -> None:
    env = FlyTrack(model=NOMINAL.with_effects(RateScale(0.5, 0.6, 0.7)))
    _, state = env.reset(jax.random.key(3))
    drone = env.drone(state)
    held = env.drone(env.advance(state, drone.applied, env.default_params)[0])
    assert np.abs(drone.rates_b).max() > 0.1
    np.testing.assert_allclose(drone.rates_b, held.rates_b, rtol=1e-5)


RATE_EFFECTS = [effect for effect in EFFECTS if effect.rates is not None]


@pytest.mark.parametrize("effect", RATE_EFFECTS, ids=lambda effect: effect.name)
def test_rates_of_a_start_stay_while_its_sticks_are_held(effect: Effect) -> None:
    drone, model = moving_drone(np.random.default_rng(5)), NOMINAL.with_effects(inside_ranges(effect, 0.5))
    drone = drone._replace(rates_b=start_rates(drone, model))
    assert np.abs(drone.rates_b).max() > 0.1 and np.isfinite(drone.rates_b).all()
    held = fly(drone, jnp.tile(jnp.stack(drone.applied), (3, 1)), model)[:, 13:16]
    np.testing.assert_allclose(held, np.tile(drone.rates_b, (3, 1)), rtol=2e-3, atol=1e-5)


# --- A model with effects -------------------------------------------------------------------------


def test_effects_stand_in_the_order_of_the_list_and_replace_their_like() -> None:
    model = NOMINAL.with_effects(LinearDrag(0.1), CommandDelay(0.01)).with_effects(Wind(1.0), LinearDrag(0.2))
    assert model.effects == (CommandDelay(0.01), Wind(1.0), LinearDrag(0.2))
    assert model.effect("linear_drag") == LinearDrag(0.2)
    assert model.effect("thrust_scale") == ThrustScale(1.0)  # absent is neutral
    assert NOMINAL.effects == ()


def test_what_is_no_effect_is_refused() -> None:
    with pytest.raises(TypeError, match="effect: found float, expected one of CommandDelay, "):
        NOMINAL.with_effects(0.3)
    with pytest.raises(KeyError, match="drag"):
        NOMINAL.effect("drag")


def test_the_packed_step_refuses_a_memory() -> None:
    x, u = pack(moving_drone(np.random.default_rng(0))), jnp.zeros(4)
    with pytest.raises(ValueError, match=r"params\.effects: found one with a memory, expected none"):
        step(x, u, DT, NOMINAL.with_effects(CommandDelay(0.0)))


def test_thrust_loss_comes_before_drag_that_follows_thrust() -> None:
    """Half the thrust is half the rotor drag: the stages are passed in their order."""
    drag, scale = RotorDrag(0.05), ThrustScale(0.5)
    upright = {"vel_w": (4.0, 0.0, 0.0), "thrust": 0.0}
    push = {
        name: force_of(upright, parameters)[0]
        for name, parameters in {"drag": [drag], "both": [scale, drag]}.items()
    }
    assert push["both"] == pytest.approx(0.5 * push["drag"], rel=1e-5)


# --- Each effect ----------------------------------------------------------------------------------


def force_of(flight: dict[str, Any], parameters: list[Any], model: ModelParameters = NOMINAL) -> np.ndarray:
    """Return the acceleration without gravity of one step, world, m/s^2."""
    x = np.zeros(21, np.float32)
    x[3:6], x[9:13] = flight["vel_w"], flight.get("quat", (1.0, 0.0, 0.0, 0.0))
    x[19] = flight.get("thrust", -1.0)
    x[20] = 24.0
    u = np.array([0.0, 0.0, 0.0, x[19]], np.float32)
    return np.asarray(step(x, u, DT, model.with_effects(*parameters)))[6:9] + GRAVITY


YAWED = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))  # 90 degrees: the world's x is the body's -y


@pytest.mark.parametrize(
    ("parameters", "vel_w", "quat", "expected"),
    [
        (LinearDrag(0.1, 0.2, 0.3), (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), (-0.1, -0.4, -0.9)),
        (LinearDrag(0.1, 0.2, 0.3), (1.0, 0.0, 0.0), YAWED, (-0.2, 0.0, 0.0)),
        (QuadraticDrag(0.1, 0.2, 0.3), (3.0, 4.0, 0.0), (1.0, 0.0, 0.0, 0.0), (-1.5, -4.0, 0.0)),
        (QuadraticDrag(0.1, 0.2, 0.3), (5.0, 0.0, 0.0), YAWED, (-5.0, 0.0, 0.0)),
        (Wind(a_x=0.5, a_y=-0.2, a_z=0.1), (3.0, 1.0, 0.0), YAWED, (0.5, -0.2, 0.1)),
        (Wind(v_x=3.0), (0.0, 0.0, 0.0), YAWED, (0.0, 0.0, 0.0)),  # moving air without drag: nothing
    ],
)
def test_forces(parameters: Any, vel_w: Any, quat: Any, expected: Any) -> None:
    found = force_of({"vel_w": vel_w, "quat": quat}, [parameters], NO_THRUST)
    np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("drag", [LinearDrag(0.1, 0.2, 0.3), QuadraticDrag(0.01, 0.02, 0.03)])
def test_drag_follows_airspeed(drag: Any) -> None:
    """Flying with the wind is hovering in still air; a headwind adds to the speed."""
    wind = Wind(v_x=4.0, v_y=-2.0, v_z=1.0)
    drifting = force_of({"vel_w": (4.0, -2.0, 1.0)}, [wind, drag], NO_THRUST)
    np.testing.assert_allclose(drifting, 0.0, atol=1e-6)
    against = force_of({"vel_w": (-1.0, 0.0, 0.0)}, [wind, drag], NO_THRUST)
    still = force_of({"vel_w": (-5.0, 2.0, -1.0)}, [drag], NO_THRUST)
    np.testing.assert_allclose(against, still, rtol=1e-5)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("drag", [LinearDrag(0.1, 0.2, 0.3), QuadraticDrag(0.1, 0.2, 0.3), RotorDrag(0.05)])
def test_drag_takes_energy_in_any_attitude(seed: int, drag: Any) -> None:
    rng = np.random.default_rng(seed)
    flight = {
        "quat": Rotation.random(rng=rng).as_quat(scalar_first=True),
        "vel_w": rng.normal(size=3) * 10,
        "thrust": rng.uniform(-0.9, 0.9),
    }
    drag_w = force_of(flight, [drag]) - force_of(flight, [])
    assert drag_w @ flight["vel_w"] < -1e-3
    body_x, body_y, body_z = Rotation.from_quat(flight["quat"], scalar_first=True).as_matrix().T
    airspeed_b = np.array([axis @ flight["vel_w"] for axis in (body_x, body_y, body_z)])
    drag_b = np.array([axis @ drag_w for axis in (body_x, body_y, body_z)])
    assert (drag_b * airspeed_b <= 1e-4).all()  # along each axis against the motion
    if isinstance(drag, RotorDrag):
        assert abs(drag_b[2]) < 1e-4  # in the rotors' plane


def test_thrust_scale_and_mass_are_one_class() -> None:
    """No log can tell them apart: 80 % of the thrust is 125 % of the mass."""
    flight = {"vel_w": (1.0, 2.0, 3.0), "thrust": 0.2}
    scaled = force_of(flight, [ThrustScale(0.8)])
    np.testing.assert_allclose(scaled, force_of(flight, [], NOMINAL._replace(m=1.25)), rtol=1e-5)


def test_rate_scale_scales_rates_only() -> None:
    scaled = random_flight([RateScale(0.9, 1.1, 1.2)], num_steps=1)[0]
    plain = random_flight([], num_steps=1)[0]
    np.testing.assert_allclose(scaled[13:16], plain[13:16] * [0.9, 1.1, 1.2], rtol=1e-6)
    np.testing.assert_array_equal(scaled[16:20], plain[16:20])


@pytest.mark.parametrize("steps", range(BUFFER_STEPS + 1))
def test_a_delay_of_whole_steps_shifts_the_commands(steps: int) -> None:
    rng = np.random.default_rng(2)
    drone = moving_drone(rng)
    commands = rng.uniform(-1.0, 1.0, (20, 4)).astype(np.float32)
    delayed = fly(drone, commands, NOMINAL.with_effects(CommandDelay(steps * DT)))
    before = np.tile(np.stack(drone.applied), (steps, 1))  # what was commanded before the flight
    shifted = fly(drone, np.concatenate([before, commands])[:20], NOMINAL.with_effects(CommandDelay(0.0)))
    np.testing.assert_allclose(delayed, shifted, rtol=1e-4, atol=1e-4)


def test_a_delay_within_a_step_is_the_mean_of_what_arrives() -> None:
    """A step of the stick that arrives 1.3 steps later moves the lag by 0.7 of it in the second step."""
    drone = moving_drone(np.random.default_rng(3))._replace(applied=Action(0.0, 0.0, 0.0, 0.0))
    model = NOMINAL.with_effects(CommandDelay(1.3 * DT))
    roll = np.asarray(fly(drone, jnp.ones((4, 4)), model))[:, 16]
    blend = 1.0 - np.exp(-DT / float(NOMINAL.tau[0]))
    assert roll[0] == 0.0
    assert roll[1] == pytest.approx(0.7 * blend, rel=1e-4)
    assert roll[2] == pytest.approx(roll[1] + blend * (1.0 - roll[1]), rel=1e-4)


def test_longer_delays_act_later() -> None:
    drone = moving_drone(np.random.default_rng(4))
    commands = jnp.ones((10, 4))
    delays = np.linspace(0.0, BUFFER_STEPS * DT, 9)
    models = [NOMINAL.with_effects(CommandDelay(float(delay))) for delay in delays]
    pitch = [float(fly(drone, commands, model)[-1, 17]) for model in models]
    assert all(later < sooner for sooner, later in pairwise(pitch))


@OVER_EFFECTS
def test_an_effect_of_one_sensor_alone_asks_for_that_sensor(effect: Effect) -> None:
    for stage, channel in (("gyro", "w"), ("accelerometer", "f"), ("battery", "v_bat")):
        if effect.stages == (stage,):
            assert channel in effect.needs


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_what_is_notable_is_inside_the_range(effect: Effect) -> None:
    neutral = effect.parameters()
    assert set(effect.notable) == set(effect.ranges) - set(effect.shapes)
    for name, size in effect.notable.items():
        assert size > 0.0
        assert effect.ranges[name].low <= getattr(neutral, name) + size <= effect.ranges[name].high
