"""What a diagnosis learns beyond its list: a law with its numbers, or nothing."""

import numpy as np
import pytest

from benchmarks import beyond, hidden
from benchmarks.diagnosis import model_of
from benchmarks.hidden.oracle import removed
from flytrack_env.model_file import load_model
from flytrack_sysid.diagnosis import diagnose, text_of, write_diagnosis
from tests.support.hidden_flights import scripted

pytestmark = pytest.mark.slow

SECONDS, SHORT_S = 60.0, 30.0
BUMP_MS, WIDTH_MS = 6.0, 1.0


PEAK = hidden.Outside("airspeed", "force", 2.0, {"speed_ms": BUMP_MS, "width_ms": WIDTH_MS})
LOAD = hidden.Outside("payload", "force", 1.5, {"string_m": 0.6})


def flights(seed, law=PEAK, seconds=SECONDS):
    """Return a plant with a law, a measured and a clean flight.

    By default the law is drag that peaks at an airspeed.
    """
    truth, log = scripted(seed, seconds, outside=law, motion="fine")
    return truth, log, hidden.fly(truth, seconds, np.random.default_rng(seed + 1))


def share_removed(found, clean):
    """Return the share of the explainable error that what was learnt removes on a clean flight."""
    assert found.learned is not None
    neutral = found.learned.effect._replace(scale=0.0)
    return removed(clean, found.base.with_effects(neutral), found.extended)[0]


def check_flights(found):
    """Check that free flights are predicted better with what was learnt."""
    without, with_law = (found.prediction.errors[name] for name in ("without_learned", "extended"))
    for horizon in ("0.5", "1", "2"):
        assert with_law["velocity_m_per_s"][horizon] < 0.9 * without["velocity_m_per_s"][horizon]


def test_a_law_is_found_with_its_numbers(tmp_path):
    truth, log, clean = flights(71)
    found = diagnose(log, model_of(truth))
    assert found.verdict == "unexplained" and found.learned is not None
    (term,) = found.learned.law.terms
    assert (term.acts, term.frame) == ("force", "air")
    (factor,) = term.factors
    assert (factor.quantity, factor.shape) == ("airspeed", "bump")
    np.testing.assert_allclose(factor.numbers, [BUMP_MS, WIDTH_MS], rtol=0.1)
    assert share_removed(found, clean) > 0.9
    check_flights(found)
    assert "learnt: force (air) += (" in text_of(found)
    _, model, report = write_diagnosis(tmp_path, found, log)
    assert load_model(model).effects == found.extended.effects
    assert "What was learnt" in report.read_text() or "bump(airspeed" in report.read_text()


def test_a_thermal_that_held_out_rows_do_not_pass_is_found():
    """On this plant, another motion seemed likelier before the search."""
    line = beyond.plant(beyond.Trial("position", 0, seed=43))
    assert (line["motion"], line["found_motion"]) == ("handout", "euler")
    assert line["is_form"] and len(line["law"]) == 1 and not line["causes"]


def test_a_load_on_a_string_stays_unexplained():
    truth, log, clean = flights(73, LOAD, SHORT_S)
    found = diagnose(log, model_of(truth))
    assert "unexplained" in found.verdict and not found.causes
    assert found.learned is None or share_removed(found, clean) > 0.0


def test_a_thrust_curve_says_where_it_could_be_motors_that_warm_up():
    truth, log, _ = beyond.flown_plant(beyond.Trial("heating", 1, seed=59))
    warm = diagnose(log, model_of(truth))
    truth, log = scripted(74, SECONDS, motion="handout")
    nominal = model_of(truth)
    of_stick = np.array([1.0, 1.0, 1.5, 1.0, 1.0, 1.0])
    curved = diagnose(log, nominal._replace(thrust_coeffs=nominal.thrust_coeffs * of_stick))
    for found, alike in ((warm, ("thrust_drift",)), (curved, ())):
        assert [one.equivalent for one in found.causes if one.effect == "thrust_curve"] == [alike]
        assert ("fly again with warm motors" in text_of(found)) == bool(alike)
