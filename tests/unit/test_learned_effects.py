"""What was learnt from a log as effects: their values, their files, and what is refused."""

import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from flytrack_env import make
from flytrack_env.effects import LearnedLaw, LearnedResidual
from flytrack_env.effects.grammar import QUANTITIES, SHAPES, Factor, Law, Term
from flytrack_env.effects.learned_residual import Input, Network, Networks
from flytrack_env.model_file import ModelFileError, load_model, save_model
from flytrack_env.params import EnvParams
from flytrack_env.state import Action
from flytrack_env.wrappers import DomainRandomization, RandomizationParams
from flytrack_sysid.loads import LoadInput, load_at
from flytrack_sysid.record import Record
from tests.support.simulated_flights import NOMINAL, drone_with, flown, held
from tests.support.tables import table

NO = (0.0, 0.0, 0.0)
DRAG = Term("force", "air", (Factor("airspeed", "bump", (4.0, 1.0)),), (-2.0, 0.0, 0.0), (0.1, 0.0, 0.0))
FLAP = Term(
    "rate",
    "body",
    (Factor("thrust", "power", (1.0, 0.0)), Factor("airspeed_x", "power", (1.0, 0.0))),
    (0.0, 0.01, 0.0),
    NO,
)
WARM = Term("force", "world", (Factor("time", "saturation", (0.05,)),), (0.0, 0.0, 3.0), NO)
LAW = Law((DRAG, FLAP, WARM))
NETWORK = Network(
    "force",
    "body",
    (Input("airspeed_x", -5.0, 5.0), Input("height", 0.0, 4.0)),
    ((1.0, 0.5, 0.2), (-0.5, 2.0, 0.0)),
    ((1.0, 2.0, 3.0), (0.5, 0.0, -1.0), (0.0, 0.0, 0.0)),
    ((0.1, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.2)),
    (0.3, 0.3, 0.3),
)
NETWORKS = Networks((NETWORK,))


def acceleration(effects: Any, **state: Any) -> np.ndarray:
    """Return what effects add to the acceleration of one step, world frame."""
    drone = drone_with(**state)
    return (flown(effects, held(), drone) - flown((), held(), drone))[0, 6:9]


def test_a_term_along_the_air_brakes_as_its_formula_says() -> None:
    found = acceleration(LearnedLaw(1.0, 0.0, Law((DRAG,))), vel_w=(3.0, 0.0, 0.0))
    np.testing.assert_allclose(found, [-2.0 * math.exp(-0.5), 0.0, 0.0], atol=1e-4)
    more = acceleration(LearnedLaw(1.0, 1.0, Law((DRAG,))), vel_w=(3.0, 0.0, 0.0))
    np.testing.assert_allclose(more, found * 1.9 / 2.0, atol=1e-4)
    half = acceleration(LearnedLaw(0.5, 0.0, Law((DRAG,))), vel_w=(3.0, 0.0, 0.0))
    np.testing.assert_allclose(half, 0.5 * found, atol=1e-4)


def test_a_product_turns_the_drone() -> None:
    drone = drone_with(vel_w=(3.0, 0.0, 0.0))
    plain, law = (flown(one, held(), drone)[0] for one in ((), LearnedLaw(1.0, 0.0, Law((FLAP,)))))
    thrust = plain[8] + NOMINAL.g
    np.testing.assert_allclose(law[13:16] - plain[13:16], [0.0, 0.01 * thrust * 3.0, 0.0], rtol=1e-4)


def test_time_since_the_start_acts() -> None:
    flight = flown(LearnedLaw(1.0, 0.0, Law((WARM,))), held(20)) - flown((), held(20))
    expected = 3.0 * (1.0 - np.exp(-0.01 * np.arange(20) / 0.05))
    np.testing.assert_allclose(flight[:, 8], expected, atol=2e-3)


def swung(times: np.ndarray, acceleration: Any, length_m: float, damping: float) -> np.ndarray:
    """Return how far a load is off below what accelerates so, by SciPy."""

    def moved(time: float, state: np.ndarray) -> list[float]:
        off, speed = state
        return [speed, -acceleration(time) - 9.81 / length_m * off - damping * speed]

    return solve_ivp(moved, (0.0, times[-1]), [0.0, 0.0], t_eval=times, max_step=0.005).y[0]


HANGING = Term("force", "load", (Factor("load", "pendulum", (0.5, 0.4)),), (3.0, 0.0, 0.0), NO)


def test_a_load_swings_as_a_pendulum_does() -> None:
    commands, law = held(150, pitch=0.2, thrust=0.1), LearnedLaw(1.0, 0.0, Law((HANGING,)))
    flight, plain = flown(law, commands), flown((), commands)
    assert not np.allclose(plain[:, 6], flight[:, 6], atol=0.5)
    times = 0.01 * np.arange(1, len(flight) + 1)
    swing = swung(times, lambda time: np.interp(time, times, flight[:, 6]), 0.5, 0.4) / 0.5
    # Both fly the same attitude, so that what differs along x is the pull.
    near = 0.02 * 3.0 * np.abs(swing).max()
    np.testing.assert_allclose(flight[:, 6] - plain[:, 6], 3.0 * swing, atol=near)


@pytest.mark.parametrize("rate", [20, 100, 500])
def test_a_load_swings_alike_at_any_step(rate: int) -> None:
    """Driven by a velocity that swings faster than the load does, for 10 s."""
    times = np.arange(10 * rate + 1) / rate
    velocity = np.sin(9.0 * times)
    vel_w = np.stack([velocity, 0.5 * velocity, 0.0 * velocity], axis=1)
    record = Record(*(np.zeros((len(times), 4)) for _ in Record._fields))
    begins = np.arange(len(times)) == 0
    record = record._replace(step_s=np.full(len(times), 1.0 / rate), begins=begins, vel_w=vel_w)
    with jax.enable_x64(True):
        load = np.asarray(load_at(LoadInput.of(record), np.arange(len(times)), (0.3, 0.5)))
    off = swung(times, lambda time: 9.0 * np.cos(9.0 * time), 0.3, 0.5)
    near = max(2.0 * (9.0 / rate) ** 2, 1e-3) * np.abs(off).max()
    np.testing.assert_allclose(load[:, 0], off, atol=near)
    np.testing.assert_allclose(load[:, 1], 0.5 * load[:, 0], atol=1e-9)


def test_a_load_hangs_still_where_a_flight_begins() -> None:
    rng = np.random.default_rng(0)
    record = Record(*(rng.normal(size=(300, 4)) for _ in Record._fields))
    vel_w, begins = rng.normal(size=(300, 3)), np.isin(np.arange(300), [0, 120])
    record = record._replace(step_s=np.full(300, 0.01), begins=begins, vel_w=vel_w)
    given, rows = LoadInput.of(record), np.array([[200, 0], [120, 119]])
    cut = jax.tree.map(lambda leaf: leaf[120:], given)
    with jax.enable_x64(True):
        found = np.asarray(load_at(given, rows, (0.7, 0.3)))
        alone = np.asarray(load_at(cut, np.array([80, 0]), (0.7, 0.3)))
    np.testing.assert_allclose(found[:, 0], alone)
    np.testing.assert_array_equal(found[[0, 1], [1, 0], :2], 0.0)
    assert np.abs(found[0, 0, :2]).min() > 0.0
    np.testing.assert_array_equal(given.mean_w[[119, 299]], vel_w[[119, 299]])


def test_a_load_flies_in_a_batch_and_begins_anew(tmp_path: Path) -> None:
    save_model(tmp_path / "model.json", NOMINAL.with_effects(LearnedLaw(1.0, 0.0, Law((HANGING,)))), {})
    env = make("FlyTrack-v0", model=tmp_path / "model.json")
    params = env.default_params.replace(max_steps_in_episode=20)
    keys = jax.random.split(jax.random.key(0), 8)
    _, states = jax.vmap(env.reset, (0, None))(keys, params)
    step, actions = jax.jit(jax.vmap(env.step, (0, 0, 0, None))), jnp.full((8, 4), 0.1)

    def off(states: Any) -> np.ndarray:
        (flight,) = (one for one in states.plant.memories if one is not None)
        return np.abs(np.stack([flight.load.off_x, flight.load.off_y])).max(axis=0)

    for _ in range(19):
        states = step(keys, states, actions, params)[1]
    assert (off(states)[np.asarray(states.time) == 19] > 1e-3).all()
    _, states, _, _, truncated, _ = step(keys, states, actions, params)
    assert truncated.any() and (off(states)[np.asarray(truncated)] == 0.0).all()


def test_a_network_adds_its_outputs_and_nothing_outside_its_range() -> None:
    effect = LearnedResidual(1.0, 0.0, NETWORKS)
    found = acceleration(effect, vel_w=(2.5, 0.0, 0.0), pos_w=(0.0, 0.0, 2.0))
    units = np.array([math.tanh(0.5 + 0.2), math.tanh(-0.25), 1.0])
    np.testing.assert_allclose(found, np.array(NETWORK.outputs) @ units, atol=1e-4)
    assert not acceleration(effect, vel_w=(6.0, 0.0, 0.0), pos_w=(0.0, 0.0, 2.0)).any()
    assert not acceleration(effect, vel_w=(2.5, 0.0, 0.0), pos_w=(0.0, 0.0, 5.0)).any()


def test_neutral_and_empty_are_absent() -> None:
    plain = flown((), held(5))
    for effect in (LearnedLaw(0.0, 0.0, LAW), LearnedLaw(1.0), LearnedResidual(0.0, 0.0, NETWORKS)):
        np.testing.assert_array_equal(flown(effect, held(5)), plain)


def extended() -> Any:
    """Return the nominal model with a law and a residual."""
    return NOMINAL.with_effects(LearnedLaw(1.0, 0.0, LAW), LearnedResidual(1.0, 0.5, NETWORKS))


def test_files_keep_what_was_learnt(tmp_path: Path) -> None:
    path = tmp_path / "extended_model.json"
    save_model(path, extended(), {})
    assert load_model(path).effects == extended().effects
    assert hash(load_model(path).effects[0].law) == hash(LAW)


def test_the_environment_flies_it_and_has_gradients() -> None:
    env = make("FlyTrack-v0", model=extended())
    keys = jax.random.split(jax.random.key(0), 16)
    _, states = jax.vmap(env.reset, (0, None))(keys, env.default_params)
    step = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))
    observations = step(keys, states, jnp.zeros((16, 4)), env.default_params)[0]
    assert np.isfinite(observations).all()

    def speed(scale: Any) -> jax.Array:
        model = env.default_params.model.with_effects(LearnedLaw(scale, 0.0, LAW))
        params = env.default_params.replace(model=model)

        def after(state: Any) -> jax.Array:
            return env.drone(env.advance(state, Action(0.0, 0.0, 0.0, 0.0), params)[0]).vel_w.norm()

        return jax.vmap(after)(states).sum()

    slope = jax.grad(speed)(1.0)
    assert np.isfinite(slope) and slope != 0.0


def test_its_spread_can_be_drawn() -> None:
    env = DomainRandomization(make("FlyTrack-v0", model=extended()))
    ends = [(LearnedLaw(None, size, LAW),) for size in (-1.0, 1.0)]
    ranges = RandomizationParams(low=ends[0], high=ends[1])
    params: EnvParams = env.default_params.replace(wrappers={DomainRandomization.key: ranges})
    env.check_params(params)
    states = [env.reset(jax.random.key(seed), params)[1] for seed in range(8)]
    spreads = [float(env.model(state, params).effect("learned_law").spread) for state in states]
    assert min(spreads) < -0.2 and max(spreads) > 0.2
    assert all(float(env.model(state, params).effect("learned_law").scale) == 1.0 for state in states)


def test_every_quantity_has_a_value_and_every_shape_a_formula() -> None:
    law = Law(
        tuple(
            Term("force", "body", (Factor(name, "power", (1.0, 0.0)),), (0.1, 0.1, 0.1), NO)
            for name in QUANTITIES
        )
    )
    assert np.isfinite(acceleration(LearnedLaw(1.0, 0.0, law), vel_w=(1.0, 2.0, 3.0))).all()
    for name, shape in SHAPES.items():
        numbers = tuple(float(place + 1) for place in range(len(shape.numbers)))
        assert shape.quantities[0] in Factor(shape.quantities[0], name, numbers).text()


@pytest.mark.parametrize(("where", "value", "expected"), table("learned_effects")["refused"])
def test_what_is_not_in_the_grammar_is_refused(
    tmp_path: Path, where: tuple[Any, ...], value: Any, expected: str
) -> None:
    path = tmp_path / "model.json"
    save_model(path, extended(), {})
    document = json.loads(path.read_text())
    effect, static = ("learned_law", "law") if where[0] == "terms" else ("learned_residual", "networks")
    at: Any = document["effects"][effect]
    keys = (static, *where[1:])
    for key in keys[:-1]:
        at = at[key]
    at[keys[-1]] = value
    path.write_text(json.dumps(document))
    with pytest.raises(ModelFileError, match=expected) as error:
        load_model(path)
    assert str(error.value).startswith(f"{path}: effects: {effect}: ")
