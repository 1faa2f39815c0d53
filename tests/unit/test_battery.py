"""A model's battery: where episodes start and end, what the policy sees, and what is warned of."""

import gymnasium
import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytrack_env import Battery, BatteryWarning, FlyTrack, nominal_parameters
from flytrack_env.dynamics import step
from flytrack_env.effects import LinearDrag, VoltageSag
from flytrack_env.state import BATTERY, STATE_SIZE, unpack_action
from flytrack_sysid.importing.flight import Craft
from tests.support.coasting import Coasting

CELL_V = (3.4, 4.2)
MASS_KG = {1: 0.032, 4: 0.6}  # by cells: a whoop, a freestyle quadcopter
NUM_STARTS = 256
BATTERY_ROW = 22  # of the observation


def craft_model(cells):
    volts = (CELL_V[0] * cells, CELL_V[1] * cells)
    return Craft((800.0, 800.0, 500.0), MASS_KG[cells], volts).nominal_model("a test")


def test_episodes_stay_within_the_battery_of_the_craft():
    model, cells = craft_model(4), 4
    assert model.battery == Battery(4.2 * cells, 3.4 * cells, 3.4 * cells, 4.2 * cells)
    env, params = gymnax.make("FlyTrack-v0", model=model, plant=Coasting())
    keys = jax.random.split(jax.random.key(0), NUM_STARTS)
    observations, states = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, params)
    volts = np.asarray(states.plant.battery_v)
    lowest = model.battery.voltage(params.reset.course_charge_low)
    assert lowest <= volts.min() < lowest + 0.1 * cells
    assert model.battery.full_v - 0.1 * cells < volts.max() <= model.battery.full_v + 1e-5
    expected = (volts - 3.8 * cells) / (0.4 * cells)
    np.testing.assert_allclose(observations[:, BATTERY_ROW], expected, atol=2e-5)


def test_a_craft_of_another_size_flies_alike_and_sags_alike():
    model = nominal_parameters().with_effects(VoltageSag(0.6), LinearDrag(0.3, 0.2, 0.1))
    half = Battery(*(0.5 * volts for volts in model.battery))
    small = model.resized(0.25, half)
    states = [np.zeros(STATE_SIZE, np.float32) for _ in range(2)]
    for state, one in zip(states, (model, small), strict=True):
        state[[2, 3, 9, BATTERY]] = 5.0, 4.0, 1.0, one.battery.full_v
    for stick in (0.9, -0.2, 0.5):
        command = jnp.array([0.3, -0.2, 0.1, stick])
        states = [
            np.asarray(step(state, command, 0.01, one))
            for state, one in zip(states, (model, small), strict=True)
        ]
    large, small_one = states
    assert large[BATTERY] < model.battery.full_v - 0.05
    np.testing.assert_allclose(2.0 * small_one[BATTERY], large[BATTERY], rtol=1e-6)
    np.testing.assert_allclose(small_one[:BATTERY], large[:BATTERY], rtol=1e-5, atol=1e-5)


def test_an_episode_ends_at_the_empty_voltage_of_its_craft():
    env = FlyTrack(model=craft_model(4), plant=Coasting())
    params = env.default_params
    drone, gate = env.sample_start(jnp.uint32(0), params)
    for volts, is_empty in ((13.61, False), (13.59, True)):
        state = env.begin(drone._replace(battery_v=jnp.float32(volts)), gate, params)
        info = env.advance(state, unpack_action(jnp.zeros(4)), params)[3]
        assert bool(info["battery_empty"]) == is_empty


def test_gymnasium_takes_the_voltages_of_the_craft():
    craft = {"model": craft_model(1), "plant": Coasting()}
    env = gymnasium.make("flytrack_env:FlyTrack-v0", **craft).unwrapped
    observation, _ = env.reset(seed=0, options={"battery_v": 4.2})
    assert observation[BATTERY_ROW] == pytest.approx(1.0, abs=1e-4)
    with pytest.raises(ValueError, match=r"battery_v.*above 3.4 and up to 4.2 V"):
        env.reset(options={"battery_v": 23.0})


def test_a_battery_beyond_the_fit_is_warned_of_or_refused():
    model = craft_model(4)
    near = model.battery._replace(fitted_low_v=16.0)
    with pytest.warns(BatteryWarning, match=r"fitted at 16 to 16.8 V.*from 13.6 to 16.8 V"):
        FlyTrack(model=model._replace(battery=near))
    with pytest.raises(ValueError, match=r"fitted at 22 to 24 V.*from 13.6 to 16.8 V"):
        FlyTrack(model=model._replace(battery=Battery(full_v=16.8, empty_v=13.6)))
