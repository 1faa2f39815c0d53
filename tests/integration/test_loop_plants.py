"""The hidden plants of the loop: the same flight as those of plain floats that the diagnosis is tested on."""

import jax
import numpy as np
import pytest

from benchmarks.hidden import Outside, Truth, draw_base, draw_effect, with_effects
from benchmarks.hidden.plant import Plant, Start
from benchmarks.loop.plants import EFFECTS, HiddenPlant
from flytrack_env import nominal_parameters
from flytrack_env.quaternion import Quaternion, Vec3
from flytrack_env.state import Action, Drone, pack

STEPS = 120


def flown_in_floats(truth: Truth, commands: np.ndarray) -> np.ndarray:
    start = Start((1.0, -2.0, 3.0), 0.7, 23.5, -0.3)
    plant, states = Plant(truth, start, np.random.default_rng(0)), []
    for command in commands:
        plant.step(tuple(map(float, command)))
        states.append([*plant.pos_w, *plant.vel_w, *plant.acc_w, *plant.quat, *plant.rates_b, *plant.applied])
        states[-1].append(plant.battery_v)
    return np.array(states)


def flown_in_jax(truth: Truth, commands: np.ndarray) -> np.ndarray:
    plant, zero = HiddenPlant(truth), Vec3(0.0, 0.0, 0.0)
    sag_v = truth.effects.get("voltage_sag", {}).get("at_full_v", 0.0) * 0.35**2
    drone = Drone(
        pos_w=Vec3(1.0, -2.0, 3.0),
        vel_w=zero,
        acc_w=zero,
        quat=Quaternion(np.cos(0.35), 0.0, 0.0, np.sin(0.35)),
        rates_b=zero,
        applied=Action(0.0, 0.0, 0.0, -0.3),
        battery_v=23.5 - sag_v,
    )

    def step(state, command):
        state = plant.step(state, Action(*command), 0.01, nominal_parameters())
        return state, pack(plant.drone(state))

    return np.asarray(jax.lax.scan(step, plant.reset(drone, nominal_parameters()), commands)[1])


@pytest.mark.parametrize("names", [(), *((name,) for name in EFFECTS), EFFECTS])
def test_same_flight_as_the_plant_in_plain_floats(names):
    rng = np.random.default_rng(len(names))
    truth = with_effects(draw_base(rng), tuple(names), rng)
    commands = np.repeat(rng.uniform(-1.0, 1.0, (STEPS // 4, 4)), 4, axis=0).astype(np.float32)
    expected, found = flown_in_floats(truth, commands), flown_in_jax(truth, commands)
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-4)


def test_every_effect_changes_the_flight():
    rng = np.random.default_rng(3)
    base = draw_base(rng)
    commands = rng.uniform(-1.0, 1.0, (STEPS, 4)).astype(np.float32)
    plain = flown_in_jax(base, commands)
    for name in EFFECTS:
        drawn = Truth(base.tau, base.coeffs, effects={name: draw_effect(name, rng)})
        assert np.abs(flown_in_jax(drawn, commands) - plain).max() > 1e-3, name


def test_refuses_what_it_does_not_fly():
    with pytest.raises(ValueError, match="gyro_bias"):
        HiddenPlant(Truth((0.03,) * 4, (0.0,) * 6, effects={"gyro_bias": {"x": 0.1}}))
    outside = Outside("heading", ("heading",), "force", 1.0, {})
    with pytest.raises(ValueError, match="heading"):
        HiddenPlant(Truth((0.03,) * 4, (0.0,) * 6, outside=outside))
