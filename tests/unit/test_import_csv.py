"""CSV logs by a mapping: units, frames, rows, errors."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flytrack_env import load_model, nominal_parameters
from flytrack_env.thrust import collective_thrust
from flytrack_sysid import LogError, import_log, load_log
from flytrack_sysid.importing.flight import Craft
from tests.support.foreign_logs import FLIP, flying, write_csv_files
from tests.support.foreign_logs import write_csv as write_one_csv
from tests.support.made_flight import GRAVITY, TIME_S, flight
from tests.support.refusals import run
from tests.support.tables import table
from tests.support.written_logs import read_mapping

HEADER = "ms,n,e,d,vn,ve,vd,ax,ay,az,p,q,r,qx,qy,qz,qw,ail,ele,rud,thr,mv"
MAPPING = read_mapping("every_unit")
CASES = table("csv_mappings")


def write_csv(path, log):
    """Write a log as others would: NED, FRD, degrees, g, cm, ms, PWM, quaternions x, y, z, w."""
    columns = [
        1e3 * log.time + 5000.0,
        100.0 * log["p"] * FLIP,
        log["v"] * FLIP,
        log["f"] * FLIP / GRAVITY,
        np.rad2deg(log["w"] * FLIP),
        log["q"][:, [1, 2, 3, 0]] * [1.0, -1.0, -1.0, 1.0],
        1500.0 + 500.0 * log["u"] * [1.0, -1.0, -1.0, 1.0],
        1e3 * log["v_bat"],
    ]
    np.savetxt(path, np.column_stack(columns), "%.17g", ",", header=HEADER, comments="")
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory, truth):
    """A folder with ``flight.csv`` of the first 3 s and its ``map.toml``."""
    out = tmp_path_factory.mktemp("csv")
    write_csv(out / "flight.csv", truth.select(slice(300)))
    (out / "map.toml").write_text(MAPPING)
    (out / "m.csv").write_text("file,rows\nflight.csv,7x")
    return out


def test_units_and_frames_come_out_ours(folder, truth):
    imported = import_log(folder / "flight.csv", "csv", folder / "map.toml")
    assert_allclose(imported.log.time, TIME_S[:300], atol=1e-9)
    for name, expected in truth.select(slice(300)).channels.items():
        values = imported.log[name]
        if name == "q":
            expected = expected * np.sign(np.sum(expected * values, axis=1, keepdims=True))
        assert_allclose(values, expected, atol=1e-6, err_msg=name)
    assert imported.craft == Craft((700.0, 600.0, 500.0), 0.5, (14.0, 16.8))
    assert imported.problems == ()


def test_rows_are_chosen_and_files_become_segments(folder, tmp_path):
    for name in ("one.csv", "two.csv"):
        (tmp_path / name).write_bytes((folder / "flight.csv").read_bytes())
    (tmp_path / "list.csv").write_text("name,good\none.csv,100\ntwo.csv,60\n")
    rows = "[rows]\nevery = 2\nfrom_s = 0.2\n"
    manifest = '[rows.manifest]\nfile = "list.csv"\nkey = "name"\ncount = "good"\n'
    (tmp_path / "map.toml").write_text(MAPPING + rows + manifest)
    arguments = [tmp_path / "one.csv", tmp_path / "two.csv"], "csv", tmp_path / "map.toml"
    imported = import_log(*arguments)
    assert_allclose(imported.log.time[:40], 0.01 * np.arange(20, 100, 2))
    assert imported.log.segment.tolist() == [0] * 40 + [1] * 20
    assert [Path(source).name for source in imported.sources] == ["one.csv", "two.csv"]
    (tmp_path / "list.csv").write_text("name,good\none.csv,100\n")
    with pytest.raises(LogError, match=r"list\.csv: columns name and good: two\.csv: missing"):
        import_log(*arguments)


@pytest.mark.parametrize(("old", "new", "message"), CASES["refused"])
def test_wrong_mappings_are_refused(folder, tmp_path, old, new, message):
    assert old in MAPPING
    (tmp_path / "map.toml").write_text(MAPPING.replace(old, new, 1))
    with pytest.raises(LogError, match=message):
        import_log(folder / "flight.csv", "csv", tmp_path / "map.toml")


@pytest.mark.parametrize(("line", "column", "value", "message"), CASES["cells"])
def test_wrong_cells_are_refused(folder, tmp_path, line, column, value, message):
    rows = [text.split(",") for text in (folder / "flight.csv").read_text().splitlines()]
    rows[line][column] = value
    (tmp_path / "bad.csv").write_text("\n".join(map(",".join, rows)))
    with pytest.raises(LogError, match=rf"bad\.csv: ({message})"):
        import_log(tmp_path / "bad.csv", "csv", folder / "map.toml")


@pytest.mark.parametrize(("files", "form", "mapping", "message"), CASES["absent"])
def test_missing_and_unmapped_files_are_refused(folder, files, form, mapping, message):
    with pytest.raises(LogError, match=message):
        import_log([folder / file for file in files], form, folder / mapping if mapping else None)


@pytest.mark.parametrize(("old", "new", "message"), CASES["refused_files"])
def test_wrong_mappings_of_several_files_are_refused(tmp_path, old, new, message):
    path, mapping = write_csv_files(tmp_path, flying(200, start_s=100.0))
    mapping.write_text(mapping.read_text().replace(old, new, 1))
    with pytest.raises(LogError, match=message):
        import_log(path, "csv", mapping)


def test_several_files_keep_their_own_clocks(tmp_path):
    path, mapping = write_csv_files(tmp_path, flying(200, start_s=100.0))
    header, *lines = (path / "x_rc_0.csv").read_text().splitlines()
    (path / "x_rc_0.csv").write_text("\n".join([header, *lines[::2]]))
    thrust = np.array([float(line.rpartition(",")[2]) for line in lines[::2]])
    log = import_log(path, "csv", mapping).log
    held = np.repeat(thrust, 2)[: len(log)]
    assert_allclose(log["u"][:, 3], held, atol=1e-8)
    for folder in (path / "x_rc_0.csv", tmp_path / "no"):
        with pytest.raises(LogError, match="found no folder"):
            import_log(folder, "csv", mapping)
    _, mapping = write_one_csv(tmp_path, flying())
    with pytest.raises(LogError, match=r"flight: found a folder, expected a file, or files\.NAME"):
        import_log(path, "csv", mapping)


def test_nominal_model_hovers_where_the_nominal_craft_does():
    nominal = nominal_parameters()
    craft = Craft((60.0, 50.0, 40.0), 0.03, (3.0, 4.0)).nominal_model("a log")
    for charge in (0.9, 1.0):  # of the highest voltage
        thrust, expected = (
            collective_thrust(0.5, full_v * charge, np.asarray(model.thrust_coeffs)) / model.m
            for model, full_v in ((craft, 4.0), (nominal, 24.0))
        )
        assert thrust == pytest.approx(expected, rel=1e-5)
    assert craft.max_rate.tolist() == [60.0, 50.0, 40.0] and craft.m == 0.03


def test_command_writes_log_details_and_model_and_keeps_clocks_if_asked(folder, tmp_path, capsys):
    late, out = write_csv(tmp_path / "late.csv", flight(TIME_S, 0.02)), tmp_path / "log.npz"
    flags = ["--format", "csv", "--map", folder / "map.toml", "--out", out]
    run("import", late, *flags, "--model-out", tmp_path / "model.json")
    output = capsys.readouterr().out
    assert "segment 0:" in output and "full stick 700, 600, 500 deg/s; mass 0.5 kg" in output
    assert re.search(r"clock of q.*\+20\..*corrected", output) and len(load_log(out)) < 2000
    details = json.loads((tmp_path / "log.import.json").read_text())
    assert details["sha256"] == load_log(out).sha256
    assert [Path(source).name for source in details["sources"]] == ["late.csv"]
    assert load_model(tmp_path / "model.json").m == 0.5
    run("import", late, *flags, "--keep-clocks")
    assert re.search(r"clock of q.*\+20\..*left as asked", capsys.readouterr().out)
    assert len(load_log(out)) == 2000
