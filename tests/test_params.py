"""Parameters that no episode can be flown with are refused by name."""

import pytest

from flytrack_env import FlyTrack

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
