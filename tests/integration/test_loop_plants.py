"""The hidden plants of the loop fly as those in plain floats on which the diagnosis is graded."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from benchmarks.hidden import Truth, draw_base, with_effects
from benchmarks.hidden.plant import Plant, Start
from benchmarks.loop.outside import SIGNALS
from benchmarks.loop.plants import EFFECTS, draw_plant_with_law, plant_of
from flytrack_env import nominal_parameters
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.state import Action, Drone, pack
from tests.support.slow import slow_but

STEPS = 120
START = Start((1.0, -2.0, 3.0), 0.7, 23.5, -0.3)


def flown_in_floats(truth: Truth, commands: np.ndarray) -> np.ndarray:
    plant, states = Plant(truth, START, np.random.default_rng(0)), []
    for command in commands:
        plant.step(tuple(map(float, command)))
        own = (plant.pos_w, plant.vel_w, plant.acc_w, plant.quat, plant.rates_b, plant.applied)
        states.append(np.concatenate([*own, [plant.battery_v]]))
    return np.array(states)


def flown_in_jax(truth: Truth, commands: np.ndarray) -> np.ndarray:
    plant, zero = plant_of(truth), Vec3(0.0, 0.0, 0.0)
    sag_v = truth.effects.get("voltage_sag", {}).get("at_full_v", 0.0) * 0.35**2
    quat = Quaternion(np.cos(0.35), 0.0, 0.0, np.sin(0.35))
    drone = Drone(Vec3(*START.pos_w), zero, zero, quat, zero, Action(0.0, 0.0, 0.0, -0.3), 23.5 - sag_v)

    def step(state, command):
        state = plant.step(state, Action(*command), 0.01, nominal_parameters())
        return state, pack(plant.drone(state))

    return np.asarray(jax.lax.scan(step, plant.reset(drone, nominal_parameters()), commands)[1])


def check_flight(truth: Truth, without: Truth | None, rng: np.random.Generator) -> None:
    """Compare both flights; that without what is tested, if any, has to differ."""
    commands = np.repeat(rng.uniform(-1.0, 1.0, (STEPS // 4, 4)), 4, axis=0).astype(np.float32)
    expected, found = flown_in_floats(truth, commands), flown_in_jax(truth, commands)
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-4)
    assert without is None or np.abs(expected - flown_in_floats(without, commands)).max() > 1e-3


@pytest.mark.parametrize("names", slow_but([(), EFFECTS], [(), EFFECTS, *((name,) for name in EFFECTS)]))
def test_the_flight_is_that_in_plain_floats(names):
    rng = np.random.default_rng(len(names))
    base = draw_base(rng)
    truth = with_effects(base, tuple(names), rng)
    check_flight(truth, base if names else None, rng)


@pytest.mark.parametrize("number", range(len(SIGNALS)), ids=SIGNALS)
def test_a_law_outside_the_list_acts_as_in_plain_floats(number):
    truth = draw_plant_with_law(number, seed=1)
    check_flight(truth, replace(truth, outside=None), np.random.default_rng(number))
