"""A fit finds the truth of a plant that shares no code with it, and says how well it knows it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from flytrack_env.dynamics import collective_thrust
from flytrack_sysid import FitError, fit
from flytrack_sysid.estimate import estimate
from flytrack_sysid.inference.parameters import (
    DRAIN,
    TAUS,
    THRUST_COEFFS,
    parameter_values,
    to_vector,
    with_values,
)
from flytrack_sysid.sensors import measure
from flytrack_sysid.split import held_out_rows
from tests.support import made_flight
from tests.support.handout_plant import GRAVITY, HandoutPlant, excited
from tests.support.slow import slow_but
from tests.support.written_logs import held_still, with_channels

PLANT = HandoutPlant()
DRAG = (0.3, 0.5, 0.2)
TRUTH = parameter_values(PLANT.model())
ACTION, BATTERY_V = np.meshgrid(np.linspace(-1, 1, 21), np.linspace(22, 24, 9))


@pytest.fixture(scope="session")
def exact():
    return excited(PLANT)


@pytest.fixture(scope="session")
def noisy(exact):
    return measure(exact, 1.0, GRAVITY, np.random.default_rng(0))


@pytest.fixture(scope="session")
def fitted(noisy):
    return fit(noisy)


def map_error(result):
    """Return the largest error of thrust between -1 and 1 and 22 and 24 V, of full thrust."""
    truth = collective_thrust(ACTION, BATTERY_V, np.array(PLANT.coeffs))
    thrust = collective_thrust(ACTION, BATTERY_V, np.asarray(result.estimate.model.thrust_coeffs))
    return float(np.abs(thrust - truth).max() / truth.max())


def tau_error(result):
    return float(np.abs(result.estimate.model.tau / np.array(PLANT.tau) - 1.0).max())


def half_widths(result):
    return {name: 0.5 * (high - low) for name, (_, low, high) in result.intervals.items()}


ABLE = {
    "p for v": (lambda exact: exact.without("a", "v"), 1e-6),
    # Without the applied action each flight begins with a guess that fades.
    "q for w": (lambda exact: exact.without("w", "uprev", "a", "p"), 1e-3),
    "500 Hz": (lambda _: excited(PLANT, repeat=5), 1e-6),
    "uneven": (lambda _: excited(PLANT, jitter=0.4), 1e-6),
}


@pytest.mark.slow
@pytest.mark.parametrize(("log_of", "tolerance"), ABLE.values(), ids=ABLE)
def test_truth_is_found_from_fewer_channels_and_at_other_steps(exact, log_of, tolerance):
    result = fit(log_of(exact))
    assert tau_error(result) < tolerance and map_error(result) < tolerance


def test_held_out_measurements_do_not_enter(noisy):
    """Also with blocks cut from one flight: no scored step begins in a held-out row."""
    time = np.arange(len(noisy)) * 0.01
    log = replace(noisy, time=time, segment=np.zeros(len(noisy), int))
    is_held_out = held_out_rows(log)
    rng = np.random.default_rng(0)
    spoilt = {name: values.copy() for name, values in log.channels.items()}
    for name in ("p", "v", "f", "w", "v_bat"):
        spoilt[name][is_held_out] += rng.normal(size=spoilt[name][is_held_out].shape)
    random = Rotation.random(int(is_held_out.sum()), rng)
    spoilt["q"][is_held_out] = random.as_quat(scalar_first=True)
    before, after = (
        estimate(measured, ~is_held_out, PLANT.model(), (*TAUS[2:], "c0"))
        for measured in (log, replace(log, channels=spoilt))
    )
    assert_allclose(to_vector(after.model), to_vector(before.model), rtol=1e-7)
    for name, noise in before.noise.items():
        assert_allclose(after.noise[name], noise, rtol=1e-6, err_msg=name)


def test_intervals_hold_the_truth(fitted):
    inside = [low <= TRUTH[name] <= high for name, (_, low, high) in fitted.intervals.items()]
    assert sum(inside) >= len(inside) - 2
    assert tau_error(fitted) < 0.02 and map_error(fitted) < 0.01
    assert (
        fitted.map_uncertainty.share < 0.01
        and map_error(fitted) < 2.0 * fitted.map_uncertainty.share
    )


@pytest.mark.slow
def test_intervals_widen_with_fewer_channels_and_with_what_the_model_lacks(noisy, fitted, dragged):
    wide, narrow = half_widths(fit(noisy.without("w"))), half_widths(fitted)
    assert all(wide[name] > 1.2 * narrow[name] for name in TAUS[:3])
    assert wide["tau_thrust"] == pytest.approx(narrow["tau_thrust"], rel=0.05)
    lacking = fit(measure(dragged, 1.0, GRAVITY, np.random.default_rng(0)))
    for name in ("tau_thrust", "c0", "c1", "c2", "c4"):
        half = half_widths(lacking)[name]
        assert abs(lacking.intervals[name].value - TRUTH[name]) < 3.0 * half
        assert half > 1.2 * narrow[name]


@pytest.fixture(scope="session")
def dragged():
    return excited(replace(PLANT, drag_b=DRAG))


@pytest.mark.slow
def test_drag_is_found(dragged):
    result = fit(dragged, effects=("linear_drag",))
    assert_allclose(result.estimate.model.effect("linear_drag"), DRAG, rtol=1e-4)
    assert tau_error(result) < 1e-4 and map_error(result) < 1e-4 and not result.warnings


def at_rest(log):
    """Return what a drone on the ground measures while its commands move."""
    return made_flight.noisy(held_still(log, log.channels.keys() - {"u"}), seed=0)


EVERYTHING = dict.fromkeys((*TAUS, *THRUST_COEFFS, DRAIN), 0.1)
REFUSED = {
    "yaw stuck": (
        lambda log: with_channels(log, u=log["u"] * (1, 1, 0, 1)),
        {},
        "u_yaw: stuck at 0; tau_yaw",
    ),
    "no rates": (lambda log: log.without("w", "q"), {}, "w and q are absent"),
    "no force": (lambda log: log.without("f", "v", "p"), {}, "f, or q with one of a, v and p"),
    "unknown name": (None, {"fixed": {"tau_jaw": 0.1}}, "fixed: tau_jaw: unknown; expected"),
    "a setting": (None, {"effects": ("quick_rates",)}, "quick_rates: known from settings and not"),
    "unknown effect": (None, {"effects": ("rag",)}, "effects: rag: no effect of that name"),
    "nothing left": (None, {"fixed": EVERYTHING}, "fixed: found every parameter"),
    "wrong sign": (
        lambda log: with_channels(log, w=log["w"] * (-1, 1, 1)),
        {"accept": True},
        "w_x: .* sign and order of u_roll and w_x",
    ),
    "a few lags": (  # what was applied before a flight is not forgotten
        lambda log: log.select(log.time < 0.14),
        {},
        r"^handout\.npz: tau_roll, .* nothing that the log measured",
    ),
    "on the ground": (at_rest, {}, "w: found no body rate that follows its command"),
    "no time constant": (None, {"fixed": {"tau_yaw": 0.0}}, "tau_yaw: found 0.0, expected 0.001"),
}


@pytest.mark.parametrize("case", slow_but(REFUSED.keys() - {"wrong sign"}, REFUSED))
def test_what_cannot_be_identified_is_refused(noisy, case):
    change, arguments, message = REFUSED[case]
    log = noisy if case == "a few lags" else noisy.select(noisy.segment % 4 == 0)
    with pytest.raises(FitError, match=message):
        fit(change(log) if change else log, **arguments)


def test_result_as_text_and_json(fitted):
    text, document = fitted.describe(), fitted.provenance()
    for name, (value, low, high) in fitted.intervals.items():
        assert low < value < high and f"{value:.6g}" in text and name in text
        assert document["intervals_95"][name]["low"] == low
    matrix = np.array(document["correlation"]["matrix"])
    assert_array_equal(np.diag(matrix), 1.0)
    assert np.abs(matrix).max() <= 1.0 and np.linalg.eigvalsh(matrix).min() > -1e-3
    for name, (noise, tolerance) in {"w": (0.1, 0.1), "f": (1.5, 0.1), "v": (0.05, 0.3)}.items():
        assert_allclose(document["left_rms"][name], noise, rtol=tolerance)


def test_replacing_values_changes_those_alone_and_refuses_unknown_names():
    model = PLANT.model()
    changed = with_values(model, {"tau_yaw": 0.07})
    assert parameter_values(changed) == {**TRUTH, "tau_yaw": 0.07}
    for name in ("tau_jaw", "linear_drag.d_x", ""):
        with pytest.raises(KeyError, match=f"{name}: unknown; expected of tau_roll"):
            with_values(model, {name: 1.0})
