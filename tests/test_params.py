"""Parameters that no episode can be flown with are refused by name."""

import jax
import pytest

from flytrack_env import FlyTrack
from flytrack_env.effects import CommandDelay
from flytrack_env.plants import Simulator

PARAMS = FlyTrack().default_params


def test_defaults_pass():
    PARAMS.check()


@pytest.mark.parametrize("name", ["start_battery_low_v", "course_battery_low_v"])
@pytest.mark.parametrize("value", [21.9, 24.1, float("nan")])
def test_battery_outside_its_range(name, value):
    with pytest.raises(ValueError, match=rf"reset\.{name}: found {value}, expected 22 to 24 V"):
        PARAMS.replace(reset=PARAMS.reset._replace(**{name: value})).check()


@pytest.mark.parametrize(
    ("name", "value"),
    [("dt", 0.0), ("dt", float("nan")), ("drone_radius", -1.0), ("max_steps_in_episode", 0)],
)
def test_values_that_must_be_positive(name, value):
    with pytest.raises(ValueError, match=f"{name}: found {value}"):
        PARAMS.replace(**{name: value}).check()


def test_drone_wider_than_an_opening():
    with pytest.raises(ValueError, match=r"drone_radius: found 0\.75"):
        PARAMS.replace(drone_radius=0.75).check()


def test_reset_refuses_a_battery_outside_its_range():
    params = PARAMS.replace(reset=PARAMS.reset._replace(start_battery_low_v=40.0))
    with pytest.raises(ValueError, match=r"reset\.start_battery_low_v: found 40"):
        FlyTrack().reset(jax.random.key(0), params)


def test_reset_refuses_another_step_than_the_plant_has():
    class OneStep(Simulator):
        dt = 0.02

    env = FlyTrack(plant=OneStep())
    with pytest.raises(ValueError, match=r"dt: found 0\.01 s, expected 0\.02 s"):
        env.reset(jax.random.key(0), PARAMS)
    env.reset(jax.random.key(0), PARAMS.replace(dt=0.02))


@pytest.mark.parametrize("delay_s", [-0.01, 0.05, float("nan")])
def test_effects_outside_their_range(delay_s):
    model = PARAMS.model.with_effects(CommandDelay(delay_s))
    with pytest.raises(ValueError, match=r"command_delay\.delay_s: found .*, expected 0 to 0\.04 s"):
        PARAMS.replace(model=model).check()
    PARAMS.replace(model=PARAMS.model.with_effects(CommandDelay(0.02))).check()
