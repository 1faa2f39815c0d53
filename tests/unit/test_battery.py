"""A model's battery: where episodes start and end, what the policy sees, and what is warned of."""

import json
from pathlib import Path
from typing import Any

import gymnasium
import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytrack_env import (
    Battery,
    BatteryWarning,
    FlyTrack,
    load_model,
    nominal_parameters,
    save_model,
)
from flytrack_env.model_file import ModelFileError
from flytrack_env.state import BATTERY, pack
from flytrack_env.thrust import collective_thrust
from flytrack_sysid.importing.flight import Craft

HANDOUT = Battery()
# Cells, mass in kg: a whoop, a cinewhoop, a small and a large freestyle quadcopter, a racer.
CRAFTS = [(1, 0.032), (2, 0.08), (3, 0.35), (4, 0.6), (6, 0.75)]
CELL_V = (3.4, 4.2)
NUM_STARTS = 256
BATTERY_ROW = 22  # of the observation


def craft_model(cells: int, mass_kg: float) -> Any:
    volts = (CELL_V[0] * cells, CELL_V[1] * cells)
    return Craft((800.0, 800.0, 500.0), mass_kg, volts).nominal_model("a test")


def thrust_to_weight(model: Any, stick: Any, volts: Any) -> np.ndarray:
    coeffs = np.asarray(model.thrust_coeffs, float)
    return np.asarray(collective_thrust(stick, volts, coeffs)) / (model.m * model.g)


@pytest.mark.parametrize(("cells", "mass_kg"), CRAFTS)
def test_episodes_stay_within_the_battery_of_the_craft(cells: int, mass_kg: float) -> None:
    model = craft_model(cells, mass_kg)
    assert model.battery == Battery(4.2 * cells, 3.4 * cells, 3.4 * cells, 4.2 * cells)
    # The nominal craft's thrust-to-weight ratios at the same share of full: 3.5 there, by its
    # docstring.
    assert thrust_to_weight(model, 1.0, model.battery.full_v) == pytest.approx(3.5, abs=0.02)
    env, params = gymnax.make("FlyTrack-v0", model=model)
    keys = jax.random.split(jax.random.key(0), NUM_STARTS)
    observations, states = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
    volts = np.asarray(states.plant.drone.battery_v)
    lowest = model.battery.voltage(params.reset.course_charge_low)
    assert lowest <= volts.min() < lowest + 0.1 * cells
    assert model.battery.full_v - 0.1 * cells < volts.max() <= model.battery.full_v + 1e-5
    expected = (volts - 3.8 * cells) / (0.4 * cells)
    np.testing.assert_allclose(observations[:, BATTERY_ROW], expected, atol=2e-5)


def test_an_episode_ends_at_the_empty_voltage_of_its_craft() -> None:
    env = FlyTrack(model=craft_model(4, 0.6))
    params = env.default_params
    drone, gate = env.sample_start(jnp.uint32(0), params)
    step = jax.jit(env.advance)
    for volts, is_empty in ((13.61, False), (13.59, True)):
        state = env.begin(drone._replace(battery_v=jnp.float32(volts)), gate, params)
        info = step(state, unpacked(jnp.zeros(4)), params)[3]
        assert bool(info["battery_empty"]) == is_empty


def unpacked(action: Any) -> Any:
    from flytrack_env.state import unpack_action

    return unpack_action(action)


def test_starts_of_the_handouts_battery_are_as_before() -> None:
    reset = FlyTrack().default_params.reset
    for charge, volts in ((reset.start_charge_low, 23.5), (reset.course_charge_low, 22.2)):
        with jax.enable_x64(False):
            low = jax.jit(HANDOUT.voltage)(jnp.float32(charge))
        assert np.float32(low) == np.float32(volts)


def test_gymnasium_takes_the_voltages_of_the_craft() -> None:
    env = gymnasium.make("flytrack_env:FlyTrack-v0", model=craft_model(1, 0.032)).unwrapped
    observation, _ = env.reset(seed=0, options={"battery_v": 4.2})
    assert observation[BATTERY_ROW] == pytest.approx(1.0, abs=1e-4)
    with pytest.raises(ValueError, match=r"battery_v.*above 3.4 and up to 4.2 V"):
        env.reset(options={"battery_v": 23.0})


def write(path: Path, **fields: Any) -> Path:
    save_model(path, nominal_parameters(), {})
    document = json.loads(path.read_text(encoding="utf-8"))
    del document["battery"]
    path.write_text(json.dumps(document | fields), encoding="utf-8")
    return path


def test_a_model_file_without_a_battery_is_warned_of(tmp_path: Path) -> None:
    with pytest.warns(BatteryWarning, match=r"m\.json: battery: missing.*handout's 22 to 24 V"):
        assert load_model(write(tmp_path / "m.json")).battery == HANDOUT


@pytest.mark.parametrize(
    ("battery", "reason"),
    [
        ([1], "battery: found .*expected a table of fields"),
        ({"full": 4.2}, r"battery\.full: unknown; expected one of full_v"),
        ({"full_v": "4.2"}, r"battery\.full_v: found .*expected a number"),
        ({"full_v": 3.4, "empty_v": 4.2}, "model.battery: found empty_v 4.2, full_v 3.4, expected"),
        (
            {"full_v": 24, "empty_v": 22, "fitted_low_v": 14, "fitted_high_v": 16.8},
            "14 to 16.8 V.*22 to 24",
        ),
    ],
)
def test_bad_batteries_are_refused(battery: Any, reason: str, tmp_path: Path) -> None:
    with pytest.raises(ModelFileError, match=reason):
        load_model(write(tmp_path / "m.json", battery=battery))


def test_a_battery_beyond_the_fit_is_warned_of_or_refused() -> None:
    model = craft_model(4, 0.6)
    near = model.battery._replace(fitted_low_v=16.0)
    with pytest.warns(BatteryWarning, match=r"fitted at 16 to 16.8 V.*from 13.6 to 16.8 V"):
        FlyTrack(model=model._replace(battery=near))
    with pytest.raises(ValueError, match=r"fitted at 22 to 24 V.*from 13.6 to 16.8 V"):
        FlyTrack(model=model._replace(battery=HANDOUT._replace(full_v=16.8, empty_v=13.6)))


def test_a_hover_stick_hovers_in_the_environment() -> None:
    """With four cells, a stick that hovers by the model carries the weight after a reset, too."""
    model = craft_model(4, 1.5)
    sticks = np.linspace(-1.0, 1.0, 4001)
    hover = sticks[np.argmin(abs(thrust_to_weight(model, sticks, model.battery.full_v) - 1.0))]
    assert hover == pytest.approx(-0.266, abs=0.002)
    env = FlyTrack(model=model._replace(tau=np.full(4, 1e-6, np.float32)))
    params = env.default_params
    drone, gate = env.sample_start(jnp.uint32(1), params)
    state = env.begin(drone._replace(battery_v=jnp.float32(model.battery.full_v)), gate, params)
    for _ in range(2):  # in the first, the rotors speed up
        state = env.advance(state, unpacked(jnp.array([0.0, 0.0, 0.0, hover])), params)[0]
    after = np.asarray(pack(env.drone(state)))
    force = after[6:9] + np.array([0.0, 0.0, model.g])
    assert np.linalg.norm(force) == pytest.approx(model.g, rel=0.01)
    assert after[BATTERY] < model.battery.full_v
