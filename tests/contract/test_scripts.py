"""Scripts: manoeuvres, files, the flights that a diagnosis asks for, and collecting them."""

import json

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from flytrack_env.dynamics import nominal_parameters
from flytrack_sysid import collect, load_log
from flytrack_sysid.diagnosis.identifiability import CHUNKS_PER_MANOEUVRE, next_flight
from flytrack_sysid.excitation import DT_S, FLIGHT_STEPS, HEIGHTS
from flytrack_sysid.inference.chunks import CHUNK_S
from flytrack_sysid.manoeuvres import FLIGHTS_PER_MANOEUVRE, MANOEUVRES, flights_of, hover_action
from flytrack_sysid.script_file import (
    ScriptError,
    build_script,
    check_script,
    load_script,
    save_script,
)
from tests.support.black_boxes import SHIPPED
from tests.support.handout_plant import HandoutPlant
from tests.support.refusals import run
from tests.support.tables import table
from tests.support.written_logs import npz_bytes

HOVER = hover_action(HandoutPlant().model())


def made(*names):
    return build_script(flights_of(names or MANOEUVRES, HOVER))


def test_every_manoeuvre_can_be_flown():
    script = made()
    check_script(script)
    assert script.kinds == tuple(name for name in MANOEUVRES for _ in range(FLIGHTS_PER_MANOEUVRE))
    assert FLIGHTS_PER_MANOEUVRE * FLIGHT_STEPS * DT_S == CHUNKS_PER_MANOEUVRE * CHUNK_S
    flights = script.commands.reshape(-1, FLIGHT_STEPS * 4)
    assert len(np.unique(np.hstack([script.starts, flights]), axis=0)) == len(flights), (
        "no flight twice"
    )


def test_hover_of_a_model():
    log = collect(HandoutPlant(), script=made("headings"))
    assert np.abs(log["v"]).max() < 1.0, "it hovers"
    model = nominal_parameters()
    assert hover_action(model._replace(m=1e3)) == 1.0, "no thrust holds it"
    assert hover_action(model._replace(thrust_coeffs=20.0 * np.eye(6)[0])) == -1.0, "any does"


def test_a_script_comes_back_the_same(tmp_path):
    script = made("speeds", "spins")
    save_script(tmp_path / "flight.npz", script)
    loaded = load_script(tmp_path / "flight.npz")
    assert loaded.kinds == script.kinds
    assert_array_equal(loaded.starts, script.starts)
    assert_array_equal(loaded.commands, script.commands)
    again = tmp_path / "again.npz"
    save_script(again, script)
    assert again.read_bytes() == (tmp_path / "flight.npz").read_bytes()


def changed(name, place, value):
    values = getattr(made("headings"), name).copy()
    values[place] = value
    return {name: values}


BAD = {
    "flight 3: starts: expected finite numbers": changed("starts", (3, 5), np.nan),
    "flight 2: commands: expected numbers within": changed("commands", (2, 7, 0), 1.5),
    "flight 0: starts: expected an applied action": changed("starts", (0, 19), -2.0),
    "flight 4: starts: expected a quaternion of norm 1": changed("starts", (4, 9), np.sqrt(4.0)),
    "flight 1: starts: expected a state within the envelope": changed("starts", (1, 2), 0.01),
    r"starts of shape \(8, 20\), .* expected": {"starts": made("headings").starts[:, :20]},
    r"commands of shape \(7, 250, 4\), expected": {"commands": made("headings").commands[:7]},
    "flight 0: kinds: expected one of headings": {"kinds": np.array(["loop"] * 8)},
    "found 0 kinds, starts of shape": {"kinds": np.array([], "U1")},
    "starts: found an array of <U4": {"starts": np.full((8, 21), "text")},
}


@pytest.mark.parametrize("message", BAD)
def test_bad_scripts_are_refused(tmp_path, message):
    script = made("headings")
    arrays = {"kinds": np.array(script.kinds), "starts": script.starts, "commands": script.commands}
    path = tmp_path / "bad.npz"
    path.write_bytes(npz_bytes({**arrays, **BAD[message]}))
    with pytest.raises(ScriptError, match=f"bad.npz: .*{message}"):
        load_script(path)


def asked(*pairs):
    return {
        "schema": 1,
        "not_identifiable": [{"effect": effect, "fly": fly} for effect, fly in pairs],
    }


def test_a_diagnosis_asks_for_flights(tmp_path):
    path = tmp_path / "diagnosis.json"
    path.write_text(
        json.dumps(asked(("gyro_scale", "spins"), ("wind", "headings"), ("imu_offset", "spins")))
    )
    planned = next_flight(path, nominal_parameters())
    assert planned.reasons == {"headings": ("wind",), "spins": ("gyro_scale", "imu_offset")}
    assert planned.script.kinds == ("headings",) * 8 + ("spins",) * 8
    text = planned.describe()
    assert "spins: to settle gyro_scale, imu_offset" in text and MANOEUVRES["spins"].how in text


@pytest.mark.parametrize(("content", "message"), table("scripts")["refused"])
def test_what_is_no_diagnosis_is_refused(tmp_path, content, message):
    path = tmp_path / "diagnosis.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ScriptError, match=f"diagnosis.json: {message}"):
        next_flight(path, nominal_parameters())
    path.write_text("{")
    with pytest.raises(ScriptError, match="cannot be read"):
        next_flight(path, nominal_parameters())


def test_commands_plan_and_collect(tmp_path, capsys):
    (tmp_path / "diagnosis.json").write_text(json.dumps(asked(("ground_effect", "low_passes"))))
    script, log = tmp_path / "flight.npz", tmp_path / "log.npz"
    run("plan", tmp_path / "diagnosis.json", "--out", script)
    assert "low_passes: to settle ground_effect" in capsys.readouterr().out
    run("collect", "--black-box", SHIPPED, "--script", script, "--out", log)
    assert load_log(log)["p"][:, 2].max() < HEIGHTS[0]
    with pytest.raises(SystemExit):
        run("collect", "--black-box", "x", "--script", script, "--minutes", 3, "--out", log)
    assert "not allowed together" in capsys.readouterr().err
