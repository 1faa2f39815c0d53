"""The truth leaves nothing of any channel; neither the heading nor held-out rows matter."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import LinearDrag
from flytrack_sysid.log import FlightLog
from flytrack_sysid.record import make_record
from flytrack_sysid.residuals import Problem, make_problem, residuals
from flytrack_sysid.split import held_out_rows
from tests.support.handout_plant import HandoutPlant, excited

PLANT = HandoutPlant()
EVERY_CHANNEL = {"w", "q", "f", "v", "v_bat"}


@pytest.fixture(scope="module")
def log() -> FlightLog:
    return excited(PLANT, flights=24)


def problem_of(log: FlightLog, judged: np.ndarray | None = None) -> Problem:
    judged = np.ones(len(log), bool) if judged is None else judged
    return make_problem(log, make_record(log), judged, PLANT.model())


def left(model: ModelParameters, problem: Problem) -> dict[str, np.ndarray]:
    """Return residuals of a model in float64."""
    with jax.enable_x64(True):
        return {name: np.asarray(values) for name, values in jax.jit(residuals)(model, problem).items()}


def largest(found: dict[str, np.ndarray]) -> dict[str, float]:
    return {name: float(np.abs(values).max()) for name, values in found.items()}


@pytest.mark.parametrize(
    ("absent", "expected"),
    [
        ((), EVERY_CHANNEL),
        (("uprev", "a"), EVERY_CHANNEL - {"f"}),
        (("v",), EVERY_CHANNEL - {"v"} | {"p"}),
        (("w", "v_bat", "v", "p"), {"q", "f"}),
        (("q",), {"w", "v_bat"}),
    ],
)
def test_truth_leaves_nothing_of_any_channel(log, absent, expected):
    problem = problem_of(log.without(*absent))
    assert set(problem.channels) == expected
    model = PLANT.model(battery_drain_v_per_min=1.0)
    if "v_bat" in absent:  # thrust follows a voltage that is not there
        del problem.channels["f"]
    # What was applied before the first row is unknown without uprev: up to LARGEST_DOUBT of it is left.
    tolerance = 0.06 if "uprev" in absent else 1e-9
    assert max(largest(left(model, problem)).values()) < tolerance
    share = [channel.counts.mean() for channel in problem.channels.values()]
    assert min(share) > (0.8 if "uprev" in absent else 0.97)


@pytest.mark.parametrize(
    "shape", [{"skip": 2}, {"repeat": 5, "flights": 4}, {"jitter": 0.4}], ids=["50 Hz", "500 Hz", "uneven"]
)
def test_truth_leaves_nothing_at_other_steps(shape):
    problem = problem_of(excited(PLANT, **shape))
    assert max(largest(left(PLANT.model(), problem)).values()) < 1e-9


def test_turning_the_world_about_the_vertical_changes_nothing(log):
    """Everything measured in the world frame is turned by 70 degrees, with a model that is wrong."""
    turn = Rotation.from_euler("z", 70.0, degrees=True)
    quat = turn * Rotation.from_quat(log["q"], scalar_first=True)
    channels = {name: turn.apply(log[name]) for name in ("p", "v", "a")}
    turned = replace(log, channels={**log.channels, **channels, "q": quat.as_quat(scalar_first=True)})
    model = PLANT.model(tau=np.full(4, 0.04), effects=(LinearDrag(0.2, 0.1, 0.3),))
    before, after = left(model, problem_of(log)), left(model, problem_of(turned))
    for name in ("w", "f", "v_bat"):
        np.testing.assert_allclose(after[name], before[name], atol=1e-9)
    for name in ("v", "q"):
        np.testing.assert_allclose(after[name], turn.apply(np.array(before[name])), atol=1e-9)


@pytest.mark.parametrize("is_one_flight", [False, True])
def test_held_out_measurements_do_not_enter(log, is_one_flight):
    """Nor do they where blocks are cut from one flight: no step is judged that began in a held-out row."""
    if is_one_flight:
        log = replace(log, time=np.arange(len(log)) * 0.01, segment=np.zeros(len(log), int))
    judged = ~held_out_rows(log)
    rng = np.random.default_rng(0)
    spoilt = {name: values.copy() for name, values in log.channels.items()}
    for name in ("p", "v", "a", "w", "v_bat"):
        spoilt[name][~judged] += rng.normal(size=spoilt[name][~judged].shape)
    spoilt["q"][~judged] = Rotation.random(int((~judged).sum()), rng).as_quat(scalar_first=True)
    model = PLANT.model(tau=np.full(4, 0.04))
    before = left(model, problem_of(log, judged))
    after = left(model, problem_of(replace(log, channels=spoilt), judged))
    for name, values in before.items():
        np.testing.assert_allclose(after[name], values, atol=1e-9, err_msg=name)
        assert np.abs(values[:6000][judged]).max() > 0.0 or name == "v_bat"
        np.testing.assert_array_equal(values[:6000][~judged], 0.0)
