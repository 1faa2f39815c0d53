"""What was learnt from a log as effects: their values, their files, and what is refused."""

import json
import math
from typing import Any

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flytrack_env import make
from flytrack_env.effects import LearnedLaw
from flytrack_env.effects.grammar import Factor, Law, Term
from flytrack_env.model_file import ModelFileError, load_model, save_model
from flytrack_env.params import EnvParams
from flytrack_env.state import Action
from flytrack_env.wrappers import DomainRandomization, RandomizationParams
from flytrack_env.wrappers.domain_randomization import sample_model
from tests.support.coasting import drone_at
from tests.support.simulated_flights import NOMINAL, drone_with, fly, held
from tests.support.tables import table

NO = (0.0, 0.0, 0.0)
DRAG = Term(
    "force", "air", (Factor("airspeed", "bump", (4.0, 1.0)),), (-2.0, 0.0, 0.0), (0.1, 0.0, 0.0)
)
FLAP = Term(
    "rate",
    "body",
    (Factor("thrust", "power", (1.0, 0.0)), Factor("airspeed_x", "power", (1.0, 0.0))),
    (0.0, 0.01, 0.0),
    NO,
)
WARM = Term("force", "world", (Factor("time", "saturation", (0.05,)),), (0.0, 0.0, 3.0), NO)
LAW = Law((DRAG, FLAP, WARM))
NUM_STEPS = 8


def flown(effects, commands, drone=None):
    """Return a flight, (num_steps, 37), with effects and no others, without compiling each law."""
    model = NOMINAL.with_effects(*effects)
    with jax.disable_jit():
        flight = fly(drone_with() if drone is None else drone, commands, model)
    return np.asarray(flight, float)


@pytest.mark.parametrize(
    ("scale", "spread", "coefficient"), [(1.0, 0.0, -2.0), (1.0, 1.0, -1.9), (0.5, 0.0, -1.0)]
)
def test_a_term_along_the_air_brakes_as_its_formula_says(scale, spread, coefficient):
    drone = drone_with(vel_w=(3.0, 0.0, 0.0))
    effects = (LearnedLaw(scale, spread, Law((DRAG,))),)
    acc_w = (flown(effects, held(), drone) - flown((), held(), drone))[0, 6:9]
    assert_allclose(acc_w, [coefficient * math.exp(-0.5), 0.0, 0.0], atol=1e-4)


def test_a_product_turns_the_drone():
    drone = drone_with(vel_w=(3.0, 0.0, 0.0))
    effects = (LearnedLaw(1.0, 0.0, Law((FLAP,))),)
    plain, turned = flown((), held(), drone)[0], flown(effects, held(), drone)[0]
    thrust = plain[8] + NOMINAL.g
    expected = [0.0, 0.01 * thrust * 3.0, 0.0]
    assert_allclose(turned[13:16] - plain[13:16], expected, rtol=1e-4)


def test_time_since_the_start_acts():
    sticks = held(NUM_STEPS)
    flight = flown((LearnedLaw(1.0, 0.0, Law((WARM,))),), sticks) - flown((), sticks)
    expected = 3.0 * (1.0 - np.exp(-0.01 * np.arange(NUM_STEPS) / 0.05))
    assert_allclose(flight[:, 8], expected, atol=2e-3)


def test_neutral_and_empty_are_absent():
    plain = flown((), held(2))
    for effect in (LearnedLaw(0.0, 0.0, LAW), LearnedLaw(1.0)):
        assert_array_equal(flown((effect,), held(2)), plain)


def extended():
    """Return the nominal model with a law."""
    return NOMINAL.with_effects(LearnedLaw(1.0, 0.0, LAW))


def test_files_keep_what_was_learnt(tmp_path):
    path = tmp_path / "extended_model.json"
    save_model(path, extended(), {})
    assert load_model(path).effects == extended().effects
    assert hash(load_model(path).effects[0].law) == hash(LAW)


def test_the_environment_flies_it_and_has_gradients():
    env = make("FlyTrack-v0", model=extended())
    drone = drone_at((15.0, 2.0, 1.35), (-4.0, 0.0, 1.0))
    state = env.begin(drone, 0, env.default_params)

    def speed(scale):
        """Return the speed after a step, and the observation."""
        model = env.default_params.model.with_effects(LearnedLaw(scale, 0.0, LAW))
        params = env.default_params.replace(model=model)
        after, *_ = env.advance(state, Action(0.0, 0.0, 0.0, 0.0), params)
        return env.drone(after).vel_w.norm(), env.observe(None, after, None, params)

    slope, observation = jax.jit(jax.grad(speed, has_aux=True))(1.0)
    assert np.isfinite(observation).all() and np.isfinite(slope) and slope != 0.0


def test_its_spread_can_be_drawn():
    env = DomainRandomization(make("FlyTrack-v0", model=extended()))
    ends = [(LearnedLaw(None, size, LAW),) for size in (-1.0, 1.0)]
    ranges = RandomizationParams(low=ends[0], high=ends[1])
    params: EnvParams = env.default_params.replace(wrappers={DomainRandomization.key: ranges})
    env.check_params(params)
    words = jax.random.bits(jax.random.key(0), (8,))
    draw = jax.jit(jax.vmap(lambda word: sample_model(word, params.model, ranges)))
    drawn = draw(words).effect("learned_law")
    assert drawn.spread.min() < -0.2 and drawn.spread.max() > 0.2
    assert (drawn.scale == 1.0).all()


@pytest.mark.parametrize(("where", "value", "expected"), table("learned_effects")["refused"])
def test_what_is_not_in_the_grammar_is_refused(tmp_path, where, value, expected):
    path = tmp_path / "model.json"
    save_model(path, extended(), {})
    document = json.loads(path.read_text())
    at: Any = document["effects"]["learned_law"]
    keys = ("law", *where[1:])
    for key in keys[:-1]:
        at = at[key]
    at[keys[-1]] = value
    path.write_text(json.dumps(document))
    with pytest.raises(ModelFileError, match=expected) as error:
        load_model(path)
    assert str(error.value).startswith(f"{path}: effects.learned_law.law")
