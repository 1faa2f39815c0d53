"""Plants whose diagnosis was wrong once, each with what is right of it.

The drawn ones were found by drawing plants that no rule was made on. Each chose a rule since.
"""

import numpy as np
import pytest

from baselines.purejaxrl_ppo import load_checkpoint
from benchmarks import adapt
from benchmarks.adapt import fly, make_plant
from benchmarks.diagnosis import Trial, make_log
from benchmarks.motors import nominal_model
from benchmarks.repeatability import Trial as Flown
from benchmarks.repeatability import simulated
from flytrack_bench.misspec.suite import load_log_suite
from flytrack_env.effects import BY_NAME
from flytrack_env.model_file import model_from_json
from flytrack_sysid.diagnosis import diagnose
from tests.support.motor_flights import flown
from tests.support.motor_models import crafts
from tests.support.written_logs import with_channels

pytestmark = pytest.mark.slow
SEED = 6101


@pytest.mark.parametrize(
    ("trial", "names", "is_explained"),
    [
        # A loss of thrust was a gain that ended, beside a thrust that was low throughout: the side
        # was chosen by another effect, which was likelier to first order.
        (Trial("onset", 1000, 6115, "semi_implicit"), {"thrust_scale"}, True),
        # A steady push beside linear drag was a local minimum: the wind moves the air.
        (
            Trial("three", 1002, SEED, "semi_implicit"),
            {"second_order_rates", "wind", "quadratic_drag"},
            True,
        ),
        # A delay of thrust that ends in flight stood in for a periodic force.
        (Trial("outside", 1, SEED, "handout"), set(), False),
        # A force that depends on the airspeed was rotor drag that ended before any held-out row.
        (Trial("outside", 2000, 6117, "fine"), set(), False),
        # A force that depends on the place was a wind that began in flight.
        (Trial("outside", 1002, 6111, "semi_implicit"), set(), False),
        # A fit ended where first order promised nothing, far from the best one. No log tells this
        # scale from the true rate_expo.
        (
            Trial("three", 7, 6104, "handout"),
            {"rate_scale", "rate_saturation", "motor_imbalance"},
            True,
        ),
        # An expo and a saturation from then on did what this scale does alone.
        (Trial("onset", 2, 6106, "handout"), {"rate_scale"}, True),
        # The time of one axis came ever nearer to 0 s without touching it.
        (
            Trial("three", 4, 6106, "handout"),
            {"rate_slew_limit", "linear_drag", "thrust_lag_asymmetry"},
            True,
        ),
    ],
)
def test_drawn_plants(trial: Trial, names: set[str], is_explained: bool) -> None:
    _, _, log, model, _ = make_log(trial)
    found = diagnose(log, model)
    assert sorted(cause.effect for cause in found.causes) == sorted(names)
    assert found.unexplained.flagged != is_explained


def test_a_drag_that_single_steps_show_beside_rates_that_nothing_explains() -> None:
    # What disturbs the rates made all flights uncertain, and these had refused the drag.
    flight = simulated(Flown("plant 5", "1"))
    diagnosis = diagnose(flight.log, flight.model)
    assert [cause.effect for cause in diagnosis.causes] == ["linear_drag"]
    assert set(diagnosis.unexplained.shares) == {"rate: heading"}


def test_a_wind_that_begins_and_ends_does_not_stand_in_for_a_thermal() -> None:
    plant = load_log_suite("misspec-v1").plant("57")
    found = diagnose(plant.log, plant.model)
    assert found.causes == () and found.unexplained.flagged


@pytest.mark.parametrize(
    ("number", "motion", "seed"),
    [
        # A drag that accelerates and a wind of 9 m/s had passed for rotor drag that is not there.
        (2, "semi_implicit", 0),
        # A fit to five short flights that spin made rates worse with effects and without them.
        (1, "fine", 1),
    ],
)
def test_effects_of_the_given_model_that_are_not_in_the_plant(
    number: int, motion: str, seed: int
) -> None:
    policy, seconds = load_checkpoint("robust"), 10.0
    plant = make_plant(adapt.Trial(adapt.PLANT, number, motion, seconds, seed))
    log = fly(plant, motion, policy, seconds, seed)
    model = model_from_json(policy.meta["model"], "model")
    causes = {cause.effect: cause for cause in diagnose(log, model).causes}
    given = {"rotor_drag", "quadratic_drag", "translational_lift"}
    assert given <= causes.keys()
    assert {name for name in causes if name in BY_NAME} <= given | plant.truth.effects.keys() | {
        "thrust_scale"
    }
    low, high = causes["rotor_drag"].parameters["h"].ci95
    assert low < 0.0 < high


def test_a_lag_at_zero_does_not_shorten_a_delay() -> None:
    """The rates of roll ended at 0 s, without a slope, and the delay 4 standard errors off."""
    truth, _, log, model, _ = make_log(Trial("three", 1004, SEED, "semi_implicit"))
    found = {cause.effect: cause.parameters for cause in diagnose(log, model).causes}
    for effect, name in (("command_delay", "delay_s"), ("second_order_rates", "roll_s")):
        low, high = found[effect][name].ci95
        assert low < truth.effects[effect][name] < high


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        # Base parameters that are free explain a mass, too: as a thrust scale and three inertias.
        ({"mass": 0.88}, ("load", 0.1)),
        # A load is not added to what explains the flight without other thrust and inertia.
        ({"thrust": [6.0, 6.0, 5.4, 6.0]}, ("rear_left", 0.9)),
    ],
)
def test_one_number_of_a_craft_whose_motors_are_commanded(changes, expected) -> None:
    log, name = flown(crafts(**changes), duration_s=30.0), expected[0]
    log = with_channels(log, sticks=np.zeros((len(log), 4)))
    diagnosis = diagnose(log, nominal_model(crafts()))
    (cause,) = diagnosis.causes
    assert any("the controller is not examined: found a row" in note for note in diagnosis.warnings)
    assert cause.effect == "motors" and set(cause.parameters) == {name}
    assert cause.parameters[name].value == pytest.approx(expected[1], rel=0.05)
