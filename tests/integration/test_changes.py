"""What changed: between two logs, and within one, by causes that begin or end in flight."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.diagnosis import Trial, make_log, model_of
from benchmarks.hidden import draw_base, draw_outside, fly, measure
from flytrack.cli import main
from flytrack_env import save_model
from flytrack_sysid import diagnose, save_log
from flytrack_sysid.diagnosis import text_of
from flytrack_sysid.log import FlightLog

pytestmark = pytest.mark.slow

CHANGED_S = 30.0
DRAG = {"d_x": 0.4, "d_y": 0.4, "d_z": 0.2}
BASE = replace(draw_base(np.random.default_rng(3)), motion="fine")
# A force that no list has, before and after alike.
BOTH = replace(BASE, outside=draw_outside(np.random.default_rng(4), "heading", 2.0))


def flown(own, seconds, seed):
    rng = np.random.default_rng(seed)
    return measure(fly(own, seconds, rng), "sensors", rng)


def test_what_changed_is_named_by_the_command(tmp_path, capsys):
    """And not what both logs lack."""
    before = flown(BOTH, CHANGED_S, 0)
    after = flown(replace(BOTH, effects={"linear_drag": DRAG}), CHANGED_S, 2)
    files = [tmp_path / name for name in ("after.npz", "before.npz", "model.json")]
    save_log(files[0], after)
    save_log(files[1], before)
    save_model(files[2], model_of(BASE), {})
    flags = ["--model", str(files[2]), "--before", str(files[1]), "--out", str(tmp_path / "report")]
    main(["diagnose", str(files[0]), *flags])
    assert "linear_drag: d_x" in capsys.readouterr().out
    diagnosis = json.loads((tmp_path / "report" / "diagnosis.json").read_text())
    assert diagnosis["verdict"] == "causes_found" and not diagnosis["unexplained"]["flagged"]
    assert [cause["effect"] for cause in diagnosis["causes"]] == ["linear_drag"]
    assert (tmp_path / "report" / "extended_model.json").exists()


ONSET_S, SECONDS = 17.3, 40.0
ROLL, PITCH = 0.003, -0.002


def truth(**effects):
    return replace(draw_base(np.random.default_rng(8)), motion="fine", effects=effects)


def test_a_cause_that_begins_in_flight_is_named_with_its_onset():
    own = replace(truth(motor_imbalance={"roll": ROLL, "pitch": PITCH}), onset_s=ONSET_S)
    found = diagnose(flown(own, SECONDS, 9), model_of(own))
    assert found.verdict == "causes_found"  # explained, from beginning to end
    (cause,) = found.causes
    assert cause.effect == "motor_imbalance" and cause.end_s is None
    assert cause.onset_s.value == pytest.approx(ONSET_S, abs=0.5)
    for name, true in (("roll", ROLL), ("pitch", PITCH)):
        low, high = cause.parameters[name].ci95
        assert low <= true <= high
    assert f"motor_imbalance from {cause.onset_s.value:.1f} ± " in text_of(found)
    assert any("as at the end of the log" in warning for warning in found.warnings)
    assert found.extended.effect("motor_imbalance").roll == pytest.approx(ROLL, rel=0.3)


def test_a_cause_that_ends_in_flight_is_not_in_the_extended_model():
    own = truth(motor_imbalance={"roll": ROLL, "pitch": PITCH})
    first, second = (flown(one, 0.5 * SECONDS, seed) for one, seed in ((own, 9), (truth(), 10)))
    channels = {name: np.concatenate([first[name], second[name]]) for name in first.channels}
    time = np.append(first.time, second.time + 0.5 * SECONDS)
    segment = np.append(first.segment, second.segment + 1)
    found = diagnose(FlightLog(time, channels, segment), model_of(own))
    (cause,) = found.causes
    assert cause.effect == "motor_imbalance" and cause.onset_s is None
    assert cause.end_s.value == pytest.approx(0.5 * SECONDS, abs=0.5)
    assert found.extended.effects == ()
    assert f"motor_imbalance until {cause.end_s.value:.1f} ± " in text_of(found)
    assert any("ended within the log" in warning for warning in found.warnings)


def test_a_loss_of_thrust_is_told_from_a_thrust_curve_that_depends_on_voltage():
    """The battery drains throughout; a disturbance absorbs what a curve leaves of the step."""
    truth, _, log, model, _ = make_log(Trial("onset", 0, 28, "fine", 100))
    (cause,) = diagnose(log, model).causes
    assert cause.effect == "thrust_scale"
    assert cause.onset_s.value == pytest.approx(truth.onset_s, abs=0.5)
    assert cause.parameters["factor"].value == pytest.approx(
        truth.effects["thrust_scale"]["factor"], abs=0.005
    )
