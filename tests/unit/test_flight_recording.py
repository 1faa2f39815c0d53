"""Recordings of flight logs: measured numbers, unexplained forces, free flight of models."""

import importlib
import sys
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from benchmarks.diagnosis import model_of
from flytrack import identification
from flytrack_env.effects import LinearDrag, MocapLatency
from flytrack_sysid import save_log
from flytrack_sysid.diagnosis import Diagnosis
from flytrack_sysid.diagnosis.result import CONSISTENT, Unexplained
from flytrack_sysid.flight_recording import write_flight_recording
from tests.support.hidden_flights import scripted
from tests.support.made_flight import TIME_S, flight
from tests.support.recordings import Recording
from tests.support.refusals import run

pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra flytrack[viz])")
trajectories = importlib.import_module("flytrack_sysid.trajectories")

SECONDS, DT_S = 8.0, 0.01
DRAG = LinearDrag(0.3, 0.4, 0.1)
SECOND = 400  # the first row of the second segment
SETTLED = 60  # rows until memories are forgotten
SCALED_FORCE = 0.1  # m of an arrow for 1 m/s^2


@pytest.fixture(scope="module")
def flown():
    """A plant with drag, as a model without it, and a log of two flights with clocks from 0 on."""
    truth, log = scripted(5, SECONDS, "none", effects={"linear_drag": DRAG._asdict()})
    segment = (np.arange(len(log)) >= SECOND).astype(int)
    return model_of(truth), replace(
        log, time=log.time - segment * log.time[SECOND], segment=segment
    )


@pytest.fixture(scope="module", autouse=True)
def small_programs():
    """All models have the same few effects: a program of all effects takes longer to compile."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(trajectories, "with_neutral_effects", lambda model, _: model)
        yield


@pytest.fixture(scope="module")
def models(flown):
    """Without what the plant has, and with it; one that flies off, and one with late poses."""
    base = flown[0].with_effects(LinearDrag(0.0, 0.0, 0.0), MocapLatency(0.0))
    return {
        "nominal": base,
        "true": base.with_effects(DRAG),
        "strong": base._replace(thrust_coeffs=50.0 * base.thrust_coeffs),
        "late": base.with_effects(MocapLatency(0.03)),
    }


@pytest.fixture(scope="module")
def flights(flown, models):
    """What is shown, by name."""
    log, shown = flown[1], {name: models[name] for name in ("nominal", "true", "strong")}
    return {flight.name: flight for flight in trajectories.measure_trajectories(log, shown)}


def test_arrows_are_the_force_that_the_model_lacks_along_the_world(flown, models, tmp_path):
    log, path = flown[1], tmp_path / "flight.rrd"
    shown = {name: models[name] for name in ("nominal", "true")}
    assert write_flight_recording(path, log, shown) == ""
    recording = Recording(path)
    quat = Rotation.from_quat(log["q"], scalar_first=True)
    drag_w = quat.apply(-np.array(DRAG) * quat.inv().apply(log["v"]))  # of the step after a row
    half = round(0.5 * trajectories.WINDOW_S / DT_S)
    entity = "/world/residual/nominal"
    drawn = zip(recording.times[entity], recording.rows[entity, "Arrows3D:vectors"], strict=True)
    steps = np.array(sorted(step for (step, _), row in drawn if row))
    is_inside = (steps > SECOND + SETTLED + half) & (steps < len(log) - half)
    rows = steps[is_inside]
    assert len(rows) > 250
    expected = np.mean([drag_w[rows - 1 + shift] for shift in range(-half, half + 1)], axis=0)
    assert np.abs(expected).max(axis=0).min() > 0.3

    def arrows(name, part):
        return recording.series(f"/world/residual/{name}", f"Arrows3D:{part}")[is_inside]

    assert_allclose(arrows("nominal", "vectors") / SCALED_FORCE, expected, atol=0.02)
    assert np.abs(arrows("true", "vectors")).max() < 1e-3 * SCALED_FORCE
    assert_allclose(arrows("nominal", "origins"), log["p"][rows], rtol=1e-6, atol=1e-6)
    plotted = recording.series("/plots/residual/nominal", "Scalars:scalars")
    assert_allclose(plotted[rows], np.linalg.norm(expected, axis=1), atol=0.02)
    assert np.isnan(plotted[[0, SECOND]]).all()


def test_ends_of_late_poses_have_no_force(flown, models):
    """Where the true pose of a row was never logged; all other rows keep their places."""
    shown, *_ = trajectories.measure_trajectories(flown[1], {"late": models["late"]})
    known = np.isfinite(shown.residuals_w["late"]).all(axis=1)
    assert len(known) == len(flown[1]) and not known[[-1, SECOND - 1]].any()
    assert known[SETTLED : SECOND - 5].all() and known[SECOND + SETTLED : -5].all()


def distance_m(shown, log):
    """Return how far a flight is from the measured one at its rows, (T,) m."""
    time_s = trajectories.time_in_line(log)
    rows = np.searchsorted(time_s, shown.time_s - 1e-6)
    assert_allclose(time_s[rows], shown.time_s, atol=1e-9)
    return np.linalg.norm(shown.positions - log["p"][rows], axis=1)


def test_a_model_flies_by_itself_and_starts_anew_every_second(flown, flights):
    log = flown[1]
    wrong, right = flights["nominal"], flights["true"]
    starts_s = right.time_s[right.restarts]
    assert starts_s[0] == 0.0
    assert right.time_s[-1] == pytest.approx(trajectories.time_in_line(log)[-1])
    gaps = np.diff(starts_s[1:])
    is_jump = gaps > 1.5  # from the first segment into the second
    assert is_jump.sum() == 1 and len(gaps) >= 5
    assert_allclose(gaps[~is_jump], 1.0, atol=1e-6)
    assert distance_m(right, log).max() < 1e-3
    away = distance_m(wrong, log)
    assert away[wrong.restarts].max() < 1e-9 and away.max() > 0.3
    assert np.isnan(right.actions).all() and "diverged" not in right.ended
    strong = flights["strong"]
    assert 3.0 < distance_m(strong, log).max() < trajectories.AWAY_M
    assert f"diverged {strong.restarts.sum() - 1} times" in strong.ended


@pytest.fixture(scope="module")
def made():
    """A made-up flight of 6 s, cut in the middle."""
    return replace(flight(TIME_S[:600]), segment=np.repeat([0, 1], 300))


def test_position_is_integrated_where_it_was_not_measured(made):
    halves = made.without("p")
    (shown,) = trajectories.measure_trajectories(halves, {})
    assert shown.name == "measured (position integrated)"
    moved = made["p"] - np.repeat(made["p"][[0, 300]], 300, axis=0)
    assert np.abs(moved).max() > 1.0
    assert_allclose(shown.positions, moved, atol=2e-3)
    (still,) = trajectories.measure_trajectories(made.without("p", "v"), {})
    assert still.name == "measured (no position)" and (still.positions == 0.0).all()
    assert np.isnan(still.states[:, 3:9]).all() and np.isfinite(still.states[:, 9:16]).all()


def test_of_a_long_log_rows_are_left_out_but_no_start(monkeypatch, made):
    monkeypatch.setattr(trajectories, "MAX_ROWS", 150)
    (shown,) = trajectories.measure_trajectories(made, {})
    kept = [*range(0, 300, 4), *range(300, 600, 4)]
    assert_array_equal(shown.positions, made["p"][kept])
    assert np.flatnonzero(shown.restarts).tolist() == [0, 75] and "1 row in 4" in shown.ended


def test_diagnose_writes_the_recording_or_says_why_not(
    flown, models, tmp_path, monkeypatch, capsys
):
    nominal = models["nominal"]
    shown = {"nominal": nominal, "base": nominal, "extended": models["true"]}
    rest = {"noise": {}, "source": "log", "sha256": ""}
    diagnosis = Diagnosis(CONSISTENT, (), Unexplained(), (), {}, **shown, **rest)
    monkeypatch.setattr(identification, "diagnose", lambda *_: diagnosis)  # the rest is real
    monkeypatch.setattr(identification, "write_diagnosis", lambda folder, *_: [folder / "a.json"])
    out, path = tmp_path / "out", tmp_path / "out" / "flight.rrd"

    def diagnosed(log):
        save_log(tmp_path / "log.npz", log)
        run("diagnose", tmp_path / "log.npz", "--out", out)
        return capsys.readouterr().out

    assert f"written: {out / 'a.json'}, {path}\n" in diagnosed(flown[1])
    drones = {entity for entity, _ in Recording(path).rows if entity.endswith("/drone")}
    of_models = {f"/world/flights/{name}/drone" for name in ("nominal", "extended")}
    assert drones == {"/world/drone", *of_models}
    text = diagnosed(flown[1].without("q"))  # which removes the recording of another log
    assert "left out" in text and "expected q (attitude)" in text and not path.exists()
    monkeypatch.setitem(sys.modules, "rerun", None)  # as if it were not installed
    monkeypatch.delitem(sys.modules, "flytrack_env.viz_rerun")
    text = diagnosed(flown[1])
    assert "pip install 'flytrack[viz]'" in text and f"written: {out / 'a.json'}\n" in text
    assert not path.exists()
