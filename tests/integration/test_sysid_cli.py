"""The commands of the identification: from a plant to a model and its report."""

import json

import gymnax
import numpy as np
import pytest

from blackbox.build import build
from flytrack.identification import load_plant
from flytrack_env import load_model, load_provenance, save_model
from flytrack_env.dynamics import nominal_parameters
from flytrack_sysid import collect, load_log, save_log
from tests.support.black_boxes import AIRLESS
from tests.support.refusals import run

TAUS = (0.02, 0.05, 0.07, 0.03)
THRUST = (-7.0, -3.0, 3.0, -1.0, 0.9, 0.9)
OTHER = AIRLESS._replace(mass=1.0, lag=TAUS, max_rate=(618.0, 618.0, 120.0), thrust=THRUST)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder in which the command collected, fitted and validated a plant of other parameters."""
    out = tmp_path_factory.mktemp("sysid")
    build(OTHER, out / "other.bin")
    run("collect", "--black-box", out / "other.bin", "--out", out / "data.npz", "--minutes", "1")
    run("fit", out / "data.npz", "--out", out / "model.json")
    run("validate", out / "model.json", out / "data.npz", "--out", out / "report")
    return out


@pytest.mark.slow
def test_artifact_of_other_parameters_is_identified_and_flies(folder):
    model = load_model(folder / "model.json")
    np.testing.assert_allclose(model.tau, TAUS, rtol=1e-4)
    terms = np.array([1.0, 0.5, 0.25, 0.125, 23.0, 11.5])  # 1, u, u^2, u^3, V, u V at u = 0.5
    assert model.thrust_coeffs @ terms == pytest.approx(np.array(OTHER.thrust) @ terms, rel=1e-4)
    _, params = gymnax.make("FlyTrack-v0", model=str(folder / "model.json"))
    np.testing.assert_array_equal(params.model.tau, model.tau)
    provenance = load_provenance(folder / "model.json")
    assert provenance["data"] == {
        "file": "data.npz",
        "sha256": load_log(folder / "data.npz").sha256,
    }
    interval = provenance["intervals_95"]["tau_yaw"]
    assert interval["low"] <= interval["value"] <= interval["high"] and interval["unit"] == "s"
    assert np.shape(provenance["correlation"]["matrix"]) == (11, 11)


@pytest.mark.slow
def test_report_is_of_the_held_out_part_or_of_all_of_another_log(folder, capsys, tmp_path):
    log, report = (
        load_log(folder / "data.npz"),
        json.loads((folder / "report/validation.json").read_text()),
    )
    assert 0.2 * len(log) < report["judged_rows"] < 0.3 * len(log)
    names = {path.name for path in (folder / "report").iterdir()}
    assert {
        "validation.html",
        "validation.txt",
        "validation.json",
        "steps.png",
        "thrust.png",
    } <= names
    shown = f"{report['one_step']['channels']['v']['mse']:.3g}"
    assert all(
        shown in (folder / "report" / f"validation.{kind}").read_text() for kind in ("txt", "html")
    )
    save_log(tmp_path / "other.csv", log.without("a"))
    run("validate", folder / "model.json", tmp_path / "other.csv", "--out", tmp_path / "report")
    assert "all rows are judged" in capsys.readouterr().out


@pytest.mark.slow
def test_fix_and_from(folder, tmp_path):
    out, start = tmp_path / "fixed.json", tmp_path / "start.json"
    save_model(start, nominal_parameters()._replace(m=2.0), {})
    run("fit", folder / "data.npz", "--out", out, "--fix", "tau_yaw=0.05", "--from", start)
    model, other = load_model(out), load_model(folder / "model.json")
    assert model.tau[2] == np.float32(0.05) and model.m == 2.0
    np.testing.assert_allclose(model.thrust_coeffs, 2.0 * other.thrust_coeffs, 1e-2)
    assert "tau_yaw" not in load_provenance(out)["intervals_95"]


MODULE = """
def in_place(x, u):
    x[8] = 20.0 * u[3]
    x[5] += 0.01 * x[8]
    x[16:20] = u
    return x
"""


def test_functions_of_the_working_folder_are_flown_and_may_change_their_arguments(
    tmp_path, monkeypatch
):
    (tmp_path / "my_robot.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    log = collect(load_plant("my_robot:in_place"), minutes=1.0)
    inside = ~log.is_start()[1:]
    change = np.diff(log["v"][:, 2])[inside]
    np.testing.assert_allclose(change, 0.01 * log["a"][1:, 2][inside], atol=1e-5)
    np.testing.assert_array_equal(log["uprev"][1:][inside], log["u"][:-1][inside])
