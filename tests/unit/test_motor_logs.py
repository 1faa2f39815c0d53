"""Logs whose commands are the outputs of motors: imports, checks, fits and what they refuse."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from flytrack_env import make, nominal_parameters
from flytrack_env.effects import Motors
from flytrack_env.motors import NAMES
from flytrack_env.toml_file import parse_toml
from flytrack_sysid.check import check_log, text_of
from flytrack_sysid.check.fix import fix_mapping
from flytrack_sysid.estimate import FitError
from flytrack_sysid.fit import fit, what_is_fitted
from flytrack_sysid.importing import import_log, mapping
from flytrack_sysid.importing.flight import Craft
from flytrack_sysid.importing.mapping import Frame
from flytrack_sysid.inference.chunks import cut_chunks
from flytrack_sysid.inference.problem import Problem
from flytrack_sysid.inference.search import FittedModel, SearchState, score_candidates
from flytrack_sysid.inference.torque import OF_EITHER, torque_notes
from flytrack_sysid.log import LogError
from flytrack_sysid.log_motion import DOUBTFUL_MOTORS, check_commands, motion_notes
from flytrack_sysid.plausibility import find_problems
from flytrack_sysid.validate import validate
from tests.support.motor_flights import COLUMNS, flown, write_csv
from tests.support.motor_models import crafts, model_of
from tests.support.tables import table
from tests.support.written_logs import through_file, with_channels

MAPPINGS = table("motor_mappings")


@pytest.fixture(scope="module")
def log():
    return flown()


@pytest.fixture(scope="module")
def imported(log, tmp_path_factory):
    """The log as it is imported."""
    path, map_file = write_csv(tmp_path_factory.mktemp("imported"), log)
    return import_log(path, "csv", map_file)


def test_motors_of_a_table_become_commands_of_a_craft(log, imported, tmp_path):
    assert imported.log.has_motors and not imported.problems
    assert imported.log.stated_mass_kg == 0.8
    np.testing.assert_allclose(imported.log["u"], log["u"], atol=1e-9)
    again = through_file(imported.log, tmp_path / "log.npz")
    assert again.has_motors and again.sha256 == imported.log.sha256
    model = imported.nominal_model()
    truth = model_of(crafts()).effect("motors")
    motors = model.effect("motors")
    for name in ("front_y", "rear_y", "radius_x", "radius_y", "radius_z", "yaw_arm", "down_s"):
        assert getattr(motors, name) == pytest.approx(getattr(truth, name), rel=1e-6)


COMMANDS = """
[command]
columns = ["w0", "w1", "w2", "f2"]
low = [-10, -10, -10, -100]
high = [10, 10, 10, 100]
clip = true
"""


def test_sticks_of_a_table_are_kept_where_full_stick_is_known(log, tmp_path):
    path, map_file = write_csv(tmp_path, log)
    text = map_file.read_text() + COMMANDS
    map_file.write_text(text)
    flight = import_log(path, "csv", map_file)
    assert "sticks" not in flight.log
    (note,) = (note for note in flight.notes if "sticks are left out" in note)
    assert "craft.max_rate_deg_s: missing" in note
    map_file.write_text(text.replace("[craft]", "[craft]\nmax_rate_deg_s = [500, 500, 200]"))
    kept = through_file(import_log(path, "csv", map_file).log, tmp_path / "log.npz")
    np.testing.assert_allclose(kept["sticks"][:, :3], np.clip(0.1 * log["w"], -1.0, 1.0))
    np.testing.assert_allclose(kept["u"], log["u"], atol=1e-9)


def test_a_known_craft_has_a_frame_that_a_mapping_may_change(log, tmp_path):
    path, map_file = write_csv(tmp_path, log, frame='craft = "iris"\npropellers = "out"')
    motors = import_log(path, "csv", map_file).nominal_model().effect("motors")
    assert motors.front_y == 0.09 and motors.yaw_arm == -0.013


def test_stated_numbers_replace_those_of_a_known_craft_whatever_they_are(monkeypatch):
    crafts = mapping.load_toml(mapping.FRAMES)
    crafts["crazyflie_2"] |= {"propellers": "out", "rotor_momentum": 1e-6}
    monkeypatch.setattr(mapping, "load_toml", lambda path: crafts)
    known = Frame(craft="crazyflie_2").known()
    assert (known.lag_s, known.propellers, known.rotor_momentum) == ((0.05, 0.05), "out", 1e-6)
    stated = {"lag_s": (0.03, 0.03), "propellers": "in", "rotor_momentum": 0.0}
    frame = Frame(craft="crazyflie_2", **stated).known()
    assert frame.motors(0.028).yaw_arm == 0.00596
    unstated = {name: getattr(known, name) for name in ("front_m", "rear_m", "yaw_arm_m")}
    for craft in (frame, Frame(**unstated, inertia_kg_m2=known.inertia_kg_m2)):
        motors = craft.motors(0.028)
        assert (motors.up_s, motors.down_s, motors.rotor_momentum) == (0.03, 0.03, 0.0)


def test_a_known_crafts_mass_and_inertia_are_not_replaced_in_silence(log, tmp_path):
    path, map_file = write_csv(tmp_path, log, frame='craft = "iris"')

    def warnings():
        return [note for note in import_log(path, "csv", map_file).notes if "warning" in note]

    both = "frame: mass_kg: found 0.8, iris has 1.535; inertia_kg_m2: found (0.004, 0.005, 0.008)"
    assert f"{both}, iris has (0.029125, 0.029125, 0.055225)" in warnings()[0]
    without = map_file.read_text().replace("inertia_kg_m2 = [0.004, 0.005, 0.008]", "")
    map_file.write_text(
        without.replace("mass_kg = 0.8", "").replace("[craft]", "[craft]\nmass_kg = 1")
    )
    assert "mass_kg: found 1.0, iris has 1.535; the rest is that of iris" in warnings()[0]
    map_file.write_text(without.replace("mass_kg = 0.8", "mass_kg = 1.535"))
    assert not warnings()


@pytest.mark.parametrize(("arguments", "expected"), MAPPINGS["fits"])
def test_a_fit_of_motors_refuses_what_acts_on_sticks(log, arguments, expected):
    with pytest.raises(FitError, match=expected):
        fit(log, model_of(crafts()), accept=True, **arguments)


def test_a_fit_of_motors_frees_their_common_delay_alone_and_the_health_of_none(log):
    _, free, _ = what_is_fitted(log, model_of(crafts()), effects=["command_delay"], accept=True)
    assert [name for name in free if name.startswith("command_delay")] == ["command_delay.delay_s"]
    assert not {f"motors.{name}" for name in NAMES} & {*free}


@pytest.mark.parametrize(("old", "new", "expected"), MAPPINGS["refused"])
def test_mappings_of_no_quadcopter_or_of_two_are_refused(log, tmp_path, old, new, expected):
    path, map_file = write_csv(tmp_path, log)
    text = map_file.read_text()
    assert old in text
    map_file.write_text(text.replace(old, new))
    with pytest.raises(LogError, match=expected):
        import_log(path, "csv", map_file)


def test_a_craft_names_what_it_lacks():
    """Full stick is not needed where motors are commanded."""
    motors = model_of(crafts()).effect("motors")
    for craft, missing in (
        (Craft(mass_kg=0.8, motors=motors), "voltage_v"),
        (Craft(voltage_v=(14.0, 16.8), motors=motors), "mass_kg"),
        (Craft(mass_kg=0.8), "max_rate_deg_s"),
    ):
        with pytest.raises(LogError, match=rf"a: craft\.{missing}: missing in log and mapping"):
            craft.nominal_model("a")


def test_a_motor_that_stands_still_is_named(log, tmp_path):
    still = with_channels(log, u=log["u"] * [1.0, 1.0, 0.0, 1.0])
    path, map_file = write_csv(tmp_path, still)
    with pytest.raises(LogError, match=r"motor rear_left: found 0\.5 of its range in every row"):
        import_log(path, "csv", map_file)
    assert "motor rear_left: found 0 in every row" in find_problems(still)[0]


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (1, 0, 2, 3), (3, 1, 2, 0), (2, 3, 0, 1)])
def test_the_order_of_motors_is_found_and_corrected(log, tmp_path, order):
    columns = [COLUMNS[motor] for motor in order]
    swapped = with_channels(log, u=log["u"][:, list(order)])
    check = check_log(swapped)
    assert "u and w" not in {pair.name for pair in (*check.pairs, *check.after)}
    if order == (0, 1, 2, 3):
        assert not check.contradicts
        return
    held = " ".join(str(motor + 1) for motor in order)
    assert f"hold motors {held}, read as 1 2 3 4" in text_of(check)
    assert any("hold motors" in problem for problem in find_problems(swapped))
    _, map_file = write_csv(tmp_path, log, columns)
    fixed = fix_mapping(map_file.read_text(), check.explanations[0])
    assert not fixed.left and parse_toml(fixed.text)["motors"]["columns"] == COLUMNS


def test_commands_of_another_kind_than_the_models_are_refused(log):
    sticks = replace(log, has_motors=False)
    model = model_of(crafts())
    with pytest.raises(LogError, match="found commands of sticks, and a model that takes motors"):
        validate(model, sticks)
    with pytest.raises(LogError, match="found commands of motors, and a model that takes sticks"):
        fit(log, nominal_parameters(), accept=True)
    with pytest.raises(LogError, match="w: missing, expected the gyro"):
        validate(model, log.without("w"))


@pytest.mark.parametrize("has_motors", [True, False])
def test_motors_without_a_frame_are_refused(log, has_motors):
    model = nominal_parameters().with_effects(Motors())
    expected = r"effects\.motors\.front_y: found 0, expected above 0"
    with pytest.raises(LogError, match=expected):
        check_commands(replace(log, has_motors=has_motors), model)
    with pytest.raises(ValueError, match=expected):
        make("FlyTrackMotors-v0" if has_motors else "FlyTrack-v0", model=model)


@pytest.mark.parametrize("origin", ["measured", "simulated"])
def test_motors_of_measured_flights_are_doubted(log, origin):
    notes = motion_notes(replace(log, origin=origin), None, None, "chosen")
    assert (DOUBTFUL_MOTORS in notes) is (origin == "measured")
    of_sticks = replace(log, origin=origin, has_motors=False)
    assert DOUBTFUL_MOTORS not in motion_notes(of_sticks, None, None, "chosen")


@pytest.mark.slow
def test_a_log_that_hardly_shows_torque_is_told_and_names_no_motor(log):
    """As NanoBench, whose motors were logged at 100 Hz and resampled."""
    model, rng = model_of(crafts()), np.random.default_rng(0)
    noisy = with_channels(log, u=np.clip(log["u"] + rng.normal(0.0, 0.3, log["u"].shape), -1, 1))
    assert not torque_notes(log, model) and not torque_notes(replace(log, has_motors=False), model)
    assert not torque_notes(log.select(slice(60)), model)  # too short to say
    still = with_channels(log, w=log["w"] * (0.0, 1.0, 1.0))  # roll never moves
    (note,) = torque_notes(still, model)
    assert "by roll 0.00, pitch 0." in note and "motors.center_y are held" in note
    (note,) = torque_notes(noisy, model)
    assert "hardly shows the motors' torque" in note and "roll 0." in note
    names = ("radius_x", "center_y", "radius_y", "center_x", "radius_z", "up_s", "down_s")
    for flown_log, held in ((log, set()), (noisy, {f"motors.{name}" for name in names})):
        scored = np.ones(len(flown_log), bool)
        with jax.enable_x64(True):
            problem = Problem.of(cut_chunks(flown_log, scored, model), model)
            state = SearchState.start(flown_log, problem)
            state, linearization = state.linearized(problem.start)
            base = FittedModel((), problem.start, 0.0, tuple(state.base_indices))
            scores = score_candidates(state, linearization, base)
        _, free, _ = what_is_fitted(flown_log, model, accept=True)
        assert held == {*state.held} - {*OF_EITHER} and held.isdisjoint(free)
        assert {"motors.radius_x", "motors.center_x"} - {*free} <= held
        candidates = [score.candidate.fields for score in scores]
        assert not held or ("motors.load",) in candidates
        for fields in candidates:
            assert {*fields}.isdisjoint(state.held)
