"""The report of a diagnosis: residuals, a plot of each cause; pages load and execute nothing."""

import re
from dataclasses import replace
from html import escape
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from benchmarks.diagnosis import model_of
from benchmarks.hidden import measure
from flytrack_env.effects import BY_NAME, EFFECTS, AccelerometerBias, LinearDrag
from flytrack_sysid.diagnosis import report
from flytrack_sysid.diagnosis.evidence import EVIDENCE
from flytrack_sysid.diagnosis.result import (
    CAUSES_FOUND,
    UNEXPLAINED,
    Cause,
    Diagnosis,
    Errors,
    Estimated,
    HalfResponse,
    NotIdentifiable,
    Prediction,
    Unexplained,
)
from flytrack_sysid.diagnosis.traces import REGRESSORS, traces
from flytrack_sysid.inference.parameters import parameter_values, with_values
from flytrack_sysid.inference.score_test import ALL_BASE_CAUSES, BASE_CAUSES
from flytrack_sysid.page import Bullets, Picture, Section, Table, Text, Verdict, page
from tests.contract.test_effects import inside_ranges
from tests.support.hidden_flights import scripted
from tests.support.slow import slow_but
from tests.support.written_logs import with_channels

SECONDS = 12.0
SETTLED = 150  # rows until a start is forgotten
DRAG = LinearDrag(0.3, 0.4, 0.1)


@pytest.fixture(scope="module")
def flown():
    """A hidden plant with drag, and the clean log of its flight."""
    truth, log = scripted(5, SECONDS, "none", effects={"linear_drag": DRAG._asdict()})
    return model_of(truth), log


@pytest.fixture(scope="module")
def measured(flown):
    """The same log as sensors would have written it."""
    return measure(flown[1], "sensors", np.random.default_rng(6))


def test_pictures_of_a_cause_that_begins_in_flight_show_the_part_in_which_it_acts(flown):
    model, log = flown
    residual_traces = traces(log, {"nominal": model}, like="nominal")
    late = Cause(
        "linear_drag",
        (),
        "velocity",
        {},
        9.0,
        3.0,
        9.0,
        9.0,
        onset_s=Estimated(7.0, (6.8, 7.2), "s"),
    )
    acting = report.while_acting(residual_traces, late, float(log.time[0]))
    expected = residual_traces.elapsed_s >= 7.0 - log.time[0]
    assert_array_equal(acting.counts["rates"], residual_traces.counts["rates"] & expected)
    assert 0.3 < acting.counts["rates"].mean() < 0.5
    ended = replace(late, onset_s=None, end_s=late.onset_s)
    kept = report.while_acting(residual_traces, ended, float(log.time[0])).counts["rates"]
    assert_array_equal(kept | acting.counts["rates"], residual_traces.counts["rates"])


def test_residuals_are_measured_minus_modelled(flown):
    base, log = flown
    wrong = base._replace(max_rate=1.1 * base.max_rate, battery_drain_v_per_min=0.5)
    wrong = wrong.with_effects(LinearDrag(0.1, 0.2, 0.0))
    residual_traces = traces(log, {"right": base.with_effects(DRAG), "wrong": wrong}, like="wrong")
    to_body = Rotation.from_quat(log["q"], scalar_first=True).inv()
    airspeed_b = to_body.apply(log["v"])[SETTLED - 1 : -1]
    lacking = (np.array([0.1, 0.2, 0.0]) - DRAG) * airspeed_b
    turned = -0.1 * log["w"][SETTLED:]
    for name, expected, tolerance in (
        ("rates", turned, 1e-5),
        ("attitude", turned, 0.05),  # of steps, not angles
        ("force", lacking, 1e-4),
        ("velocity", lacking, 1e-3),
    ):
        assert np.abs(expected).max() > 0.1
        for model, values in (("wrong", expected), ("right", 0.0)):
            residuals = residual_traces.residuals[model][name][SETTLED:]
            assert_allclose(residuals - values, 0.0, atol=tolerance, err_msg=name)
    drained = log["v_bat"][:, 0] - log["v_bat"][0, 0] + 0.5 / 60.0 * log.time
    assert_allclose(residual_traces.residuals["wrong"]["battery"][:, 0], drained, atol=1e-6)


def shown(model, cause):
    """Return the model with a cause, far from neutral."""
    if cause in BASE_CAUSES:
        values = parameter_values(model)
        return with_values(model, {name: 1.4 * values[name] for name in BASE_CAUSES[cause]})
    return model.with_effects(inside_ranges(BY_NAME[cause], 0.9))


# A diagnosis does not search settings, so that their models take another compiled program.
@pytest.mark.parametrize("are_settings", slow_but([False], [False, True]))
def test_every_cause_has_a_plot_in_which_it_shows(flown, are_settings):
    model, log = flown
    effects = [effect for effect in EFFECTS if effect.search.is_setting == are_settings]
    base = model.with_effects(*(effect.parameters() for effect in effects))
    # Some effects act near the ground only.
    low = log["p"] - [0.0, 0.0, log["p"][:, 2].min() - 0.1]
    log = with_channels(log, p=low)
    causes = [effect.name for effect in effects]
    if not are_settings:
        causes += BASE_CAUSES
        assert set(EVIDENCE) == {*(effect.name for effect in EFFECTS), *ALL_BASE_CAUSES}
    models = {"without": base, **{cause: shown(base, cause) for cause in causes}}
    residual_traces = traces(log, models, like="without")
    sizes = {"rates": 0.01, "attitude": 0.01, "force": 0.05, "velocity": 0.05, "battery": 0.02}
    for cause in causes:
        evidence = EVIDENCE[cause]
        assert evidence.words and evidence.reading and evidence.panels
        explained = []
        for panel in evidence.panels:
            assert panel.regressor in REGRESSORS
            (less, counts), (full, _) = (
                residual_traces.column(name, panel.residual) for name in ("without", cause)
            )
            explained.append(
                np.abs(full - less)[counts].max() / sizes[panel.residual.split("_")[0]]
            )
        assert max(explained) > 1.0, cause


@pytest.fixture(scope="module")
def diagnosis(flown, measured):
    """A diagnosis put together by hand."""
    base = flown[0]
    nominal = base._replace(tau=1.3 * base.tau)
    bias = AccelerometerBias(0.2, 0.0, 0.0)
    drag = {
        name: Estimated(value, (0.9 * value, 1.1 * value), "1/s")
        for name, value in DRAG._asdict().items()
    }
    lag = {"tau_roll": Estimated(0.03, (0.02, 0.04), "s")}
    offset = {"x": Estimated(0.2, (0.1, 0.3), "m/s^2")}
    causes = (
        Cause("linear_drag", (), "force", drag, 900.0, 310.0, 800.0, 500.0, "rotor_drag"),
        Cause("tau_roll", ("command_delay",), "rates", lag, 90.0, 31.0, 80.0, 1.0),
        Cause("accelerometer_bias", (), "force", offset, 50.0, 20.0, 40.0, 30.0),
    )
    shares = {"nominal": 1.0, "refitted_base": 0.8, "extended": 0.2, "noise_floor": 0.1}
    error = {
        name: Errors({"w": 0.5 * share, "q": float("nan")}, {"1": 0.5 * share})
        for name, share in shares.items()
    }
    return Diagnosis(
        verdict=f"{CAUSES_FOUND}+{UNEXPLAINED}",
        causes=causes,
        unexplained=Unexplained(True, ("position",), {"force: position": 0.3}),
        not_identifiable=(
            NotIdentifiable("ground_effect", 0.02, "m^2", ("thrust_scale",), "low_passes"),
        ),
        error=error,
        nominal=nominal,
        base=base,
        extended=base.with_effects(DRAG, bias),
        noise={"rates": [0.1, 0.1, 0.1]},
        source="<script>flight</script>",
        sha256=measured.sha256,
        warnings=("something to know",),
        half_response_s={
            "extended": {
                "roll": HalfResponse(0.0281, 0.0402, (0.0276, 0.0286)),
                "yaw": HalfResponse(0.347, 0.347, (0.3, np.inf)),
            }
        },
    )


def test_page_says_all_and_loads_nothing(tmp_path, diagnosis, measured):
    report.write_diagnosis(tmp_path, diagnosis, measured)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    for words in (
        *(cause.effect for cause in diagnosis.causes),
        *(EVIDENCE[cause.effect].words for cause in diagnosis.causes),
        "0.3\u00a0[0.27,\u00a00.33]\u00a01/s",
        "low passes",
        "something to know",
        "The model lacks drag in proportion to airspeed; offset of the accelerometer, ",
        "flies 80 % closer after 1 s (0.1 m instead of 0.5 m on held-out flight; "
        "by the refitted base 20 %, the named effects 60 %)",
        "28.1 ± 0.5 (40)",
        "not determined",
        "&lt;script&gt;flight",
    ):
        assert words in text.replace("&#x27;", "'"), words
    assert not re.search(r"https?://|url\(|@import|<link|<script", text)
    assert (
        text.count('src="data:image/png;base64,') == text.count("<img") == 1 + len(diagnosis.causes)
    )
    assert len(text) < 3e6


BLIND = Prediction({"placebo": {"position_m": {"1": 0.27}}})
GAINS = {
    "by the refitted base 95 %, the named effects 0 %; "
    "a guess that ignores the commands, 0.27 m)": (
        {"nominal": 8.7, "refitted_base": 0.404, "extended": 0.403},
        {"prediction": BLIND},
    ),
    "by the refitted base 40 %, the named effects 10 %, the learnt law 30 %": (
        {"nominal": 1.0, "refitted_base": 0.6, "without_learned": 0.5, "extended": 0.2},
        {"learned": SimpleNamespace(text=lambda: "a law")},
    ),
}


@pytest.mark.parametrize("expected", GAINS)
def test_what_refitting_a_guess_or_a_learnt_law_reaches_is_no_gain_of_effects(diagnosis, expected):
    sizes, changes = GAINS[expected]
    errors = {name: Errors({}, {"1": size}) for name, size in sizes.items()}
    assert expected in report.text_of(replace(diagnosis, error=errors, **changes))


def test_what_is_beyond_the_list_is_told_and_not_named(diagnosis):
    drag, lag, _ = diagnosis.causes
    at_end = replace(lag, beyond="tau_roll at most 0.001 s")
    changed = replace(diagnosis, causes=(drag,), beyond=(at_end,))
    text = report.describe_verdict(changed).text
    assert text.startswith(
        "The model lacks drag in proportion to airspeed. Named linear_drag: flies"
    )
    assert (
        "Beyond the list, so that its cause may be another: lag of roll (tau_roll at most 0.001 s)."
        in text
    )
    alone = replace(changed, causes=(), unexplained=Unexplained())
    assert "lag of roll (tau_roll at most 0.001 s)" in report.describe_verdict(alone).text
    (stored,) = alone.as_json()["beyond_the_list"]
    assert stored["effect"] == "tau_roll" and alone.as_json()["causes"] == []


def test_no_manoeuvre_is_recommended_where_none_is_known(diagnosis):
    unseen = NotIdentifiable("wind", 0.1, "m/s", (), "")
    assert "recommended" not in report.text_of(replace(diagnosis, not_identifiable=(unseen,)))
    flown = replace(unseen, fly="hover")
    assert "recommended: fly hover" in report.text_of(
        replace(diagnosis, not_identifiable=(unseen, flown))
    )


@pytest.mark.slow
def test_page_of_a_log_of_few_channels(diagnosis, measured):
    text = report.html_of(diagnosis, measured.without("w", "f", "v_bat"))
    assert "attitude or velocity replace them" in text and text.count("<img") == 1 + len(
        diagnosis.causes
    )


# --- Any page -------------------------------------------------------------------------------------

PNG = b"\x89PNG\r\n\x1a\n and the rest"
HOSTILE = '"><script>alert(1)</script><a href="https://example.org/x">'


def full_page(words):
    """Return a page with these words in every place that takes text."""
    parts = [
        Text(words),
        Verdict(words, "good"),
        Bullets([words]),
        Table([words, "b"], [[words, "2"]], caption=words),
        Table([words, "b"], [[words, "2"]], caption=words, is_text=True),
        Picture(PNG, words),
    ]
    return page(words, [Section(words, parts)], introduction=[Text(words)])


def test_hostile_text_is_only_shown_and_nothing_is_loaded_from_elsewhere():
    hostile, plain = full_page(HOSTILE), full_page("plain")
    assert hostile.replace(escape(HOSTILE), "plain") == plain
    for name in set(re.findall(r"<(\w+)", plain)) - {"meta", "img"}:
        assert len(re.findall(rf"<{name}\b", plain)) == plain.count(f"</{name}>"), name
    (target,) = re.findall(r'(?:src|href)="([^"]*)"', plain)
    assert target.startswith("data:image/png;base64,")
    assert not re.search(r"https?://|url\(|@import|<link|<script", plain)
