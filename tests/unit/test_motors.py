"""The body driven by motors, against rigid bodies that share no code with it."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from benchmarks.motor_craft import Pilot, State, advance, fly, hovering, speed_for
from flytrack_env import effects, load_model, make, nominal_parameters, save_model
from flytrack_env.dynamics import move
from flytrack_env.effects.motors import Spinning
from flytrack_env.model_file import ModelFileError
from flytrack_env.motors import NAMES
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.state import Action, Drone, pack, unpack_action
from flytrack_env.wrappers import DomainRandomization
from flytrack_sysid.inference.parameters import fields_of_sticks
from flytrack_sysid.inference.score_test import candidates_for, searched_in
from tests.support.compiling import quick_jit
from tests.support.motor_models import crafts, model_of
from tests.support.simulated_flights import padded

DT = 0.01
TILTED = np.array([[4.0, -0.2, 0.3], [-0.2, 5.0, 0.1], [0.3, 0.1, 8.0]]) * 1e-3
WHOLE = crafts(
    inertia=TILTED, thrust=[6.0, 5.8, 5.4, 6.0], drag=[0.1, 0.12, 0.2], damping=[0.01, 0.012, 0.005]
)


@pytest.fixture(autouse=True)
def in_float64():
    with jax.enable_x64(True):
        yield


@quick_jit
def compiled_flight(model, start, commands, dt):
    def step(state, command):
        moved = move(*state, unpack_action(command), dt, model)
        return moved[:2], pack(moved.after)

    return jax.lax.scan(step, start, commands)[1]


def simulate(model, start, commands, dt=DT):
    """Return a flight's states, (num_steps, 21); every model is flown by one program."""
    model = jax.tree.map(lambda leaf: np.asarray(leaf, float), model)
    return np.asarray(compiled_flight(model, start, padded(commands), dt))[: len(commands)]


def late_model(craft, delay_s=0.0):
    """Return the model of a craft whose commands are late."""
    return model_of(craft).with_effects(effects.CommandDelay(delay_s))


def begun(model, state):
    """Return the drone and the memories of a NumPy craft's state."""
    first = State(*(leaf[0] for leaf in state))
    full = np.deg2rad(np.asarray(model.max_rate, float))
    drone = Drone(
        Vec3(*first.pos),
        Vec3(*first.vel),
        Vec3(0.0, 0.0, 0.0),
        Quaternion(*Rotation.from_matrix(first.turn).as_quat(scalar_first=True)),
        Vec3(*first.rates),
        Action(*first.rates / full, 2.0 * first.speeds.mean() - 1.0),
        24.0,
    )
    drone = jax.tree.map(jnp.asarray, drone)
    memories = tuple(
        Spinning(tuple(map(jnp.asarray, first.speeds))) if isinstance(memory, Spinning) else memory
        for memory in effects.start_memories(model.effects, drone)
    )
    return drone, memories


def both(craft, state, commands, dt=DT):
    """Return the states after each command of the NumPy craft, (n, 15 + 3), and of the model."""
    model = late_model(craft)
    flown = simulate(model, begun(model, state), 2.0 * commands - 1.0, dt)
    step_s, rows = (1e-4 if len(commands) < 10 else 1e-3), []
    for command in commands:
        for _ in range(round(dt / step_s)):
            state = advance(craft, state, command[None], step_s)
        quat = Rotation.from_matrix(state.turn[0]).as_quat(scalar_first=True)
        rows.append(np.concatenate([state.pos[0], state.vel[0], quat, state.rates[0]]))
    shown = flown[:, [*range(6), *range(9, 16)]]
    truth = np.array(rows)
    sign = np.sign(np.sum(shown[:, 6:10] * truth[:, 6:10], axis=1, keepdims=True))
    truth[:, 6:10] *= sign
    return truth, shown


def held(*motors, steps=5):
    return np.tile(np.array(motors, float), (steps, 1))


BALANCED = crafts(places=[[-0.1, -0.1, 0], [0.1, -0.1, 0], [-0.1, 0.1, 0], [0.1, 0.1, 0]])
HOVER = float(speed_for(crafts(), 0.8 * 9.80665 / (4 * 6.0) * np.ones(1))[0])


def test_a_hover_with_delayed_commands_stays_level():
    model = late_model(BALANCED, 0.02)
    drone, _ = begun(model, hovering(BALANCED))
    memories = effects.start_memories(model.effects, drone)
    flown = simulate(model, (drone, memories), 2.0 * held(*[HOVER] * 4, steps=20) - 1.0)
    assert_allclose(flown[:, 13:16], 0.0, atol=1e-9)
    assert_allclose(flown[:, 3:6], 0.0, atol=1e-9)
    turning = drone._replace(applied=Action(0.2, -0.1, 0.1, 0.4))
    (past, spinning, *_), (stick_past,) = (
        effects.start_memories(of, turning) for of in (model.effects, (effects.CommandDelay(0.02),))
    )
    assert past == (Action(0.4, 0.4, 0.4, 0.4),) * 4 and spinning.speeds == (0.7,) * 4
    assert stick_past == (turning.applied,) * 4


TURNS = ((-1, 1, 1), (-1, -1, -1), (1, 1, -1), (1, -1, 1))  # signs of roll, pitch and yaw


@pytest.mark.parametrize(("motor", "turn"), [*enumerate(TURNS)], ids=NAMES)
def test_each_motor_turns_the_craft_as_it_should(motor, turn):
    commands = held(*[HOVER] * 4)
    commands[:, motor] += 0.2
    truth, flown = both(BALANCED, hovering(BALANCED), commands)
    assert_array_equal(np.sign(flown[-1, 10:]), turn)
    assert_allclose(flown, truth, atol=4e-4)


def test_a_body_without_torque_keeps_momentum_and_energy():
    free = crafts(inertia=TILTED, thrust=[1e-9] * 4, momentum=0.0)
    start = hovering(free)._replace(rates=np.array([[4.0, 3.0, 2.0]]), speeds=np.zeros((1, 4)))
    truth, flown = both(free, start, held(0, 0, 0, 0, steps=200))
    rates = np.concatenate([[[4.0, 3.0, 2.0]], flown[:, 10:]])
    energy = np.einsum("ni,ij,nj->n", rates, TILTED, rates)
    assert_allclose(energy, energy[0], rtol=1e-5)
    turn = Rotation.from_quat(flown[:, 6:10], scalar_first=True)
    momentum = turn.apply(flown[:, 10:] @ TILTED)
    assert_allclose(momentum, np.tile(TILTED @ [4.0, 3.0, 2.0], (200, 1)), atol=2e-4)
    assert_allclose(flown[-1, 10:], truth[-1, 10:], atol=2e-3)


def test_a_flown_minute_part_is_that_of_the_independent_craft_to_second_order():
    flight = fly(WHOLE, Pilot(np.random.default_rng(3), 1, 4.0, 6.0), 4.0)
    state = State(*(leaf[200] for leaf in flight.states))
    commands = flight.commands[200:260, 0]
    truth, flown = both(WHOLE, state, commands)
    coarse = np.abs(flown - truth).max()
    assert coarse < 3e-4  # of metres, m/s and rad/s, after 0.6 s
    finer = np.repeat(commands, 2, axis=0)
    fine = np.abs(both(WHOLE, state, finer, DT / 2)[1][1::2] - truth).max()
    assert 3.0 < coarse / fine < 5.0


SETTINGS_OF_STICKS = [
    ("rate_scale.roll", effects.RateScale(roll=0.9)),
    ("rate_saturation.yaw", effects.RateSaturation(yaw=0.2)),
    ("thrust_lag_asymmetry.ratio", effects.ThrustLagAsymmetry(1.5)),
    ("second_order_rates.roll_s", effects.SecondOrderRates(0.01)),
    ("command_delay.thrust_extra_s", effects.CommandDelay(0.01, thrust_extra_s=0.01)),
    ("betaflight_loop.roll_arm", effects.BetaflightLoop(roll_arm=1.0)),
]


@pytest.mark.parametrize(("field", "parameters"), SETTINGS_OF_STICKS)
def test_effects_of_sticks_beside_motors_are_refused(field, parameters, tmp_path):
    expected = rf"effects\.{field}: found .*: it acts on sticks, and with the effect motors"
    model = model_of(BALANCED)
    with pytest.raises(ValueError, match=expected):
        model.with_effects(parameters)
    forced = model._replace(effects=effects.merge(model.effects, parameters))
    with pytest.raises(ValueError, match=expected):
        make("FlyTrackMotors-v0", model=forced)
    save_model(tmp_path / "model.json", forced, {})
    with pytest.raises(ModelFileError, match=rf"model\.json: {expected}"):
        load_model(tmp_path / "model.json")
    neutral = model.with_effects(type(parameters)(), effects.CommandDelay(0.01))
    assert neutral.with_effects(effects.Motors()).with_effects(parameters)


def test_effects_of_sticks_are_not_drawn_beside_motors():
    env = DomainRandomization(make("FlyTrackMotors-v0"))
    params = env.default_params
    env.check_params(params)
    ranges = params.wrappers[env.key]._replace(
        low=(effects.RateScale(0.9, 1.0, 1.0),), high=(effects.RateScale(1.0, 1.0, 1.0),)
    )
    with pytest.raises(ValueError, match=r"effects\.rate_scale\.roll: found 0\.9"):
        env.check_params(params.replace(wrappers={**params.wrappers, env.key: ranges}))


def test_effects_of_sticks_are_no_candidates_beside_motors():
    problem = SimpleNamespace(like=model_of(crafts()), given_effects=("motors",))
    fields = {field for candidate in candidates_for(problem) for field in candidate.fields}
    assert "command_delay.delay_s" in fields and "gyro_scale.x" in fields
    assert not fields & fields_of_sticks(problem.like)
    assert fields_of_sticks(nominal_parameters()) == set()
    # Nor is a scale of the force alone.
    searched = {candidate.effect for candidate in candidates_for(problem)}
    assert "motors" in searched and "thrust_scale" not in {*searched, *searched_in(problem)}
    of_sticks = SimpleNamespace(like=nominal_parameters(), given_effects=())
    assert "thrust_scale" in searched_in(of_sticks)
