"""CSV logs by a mapping: units, frames, rows, errors."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack.cli import main
from flytrack_env import load_model, nominal_parameters
from flytrack_sysid import FlightLog, LogError, import_log, load_log
from flytrack_sysid.importing.flight import Craft
from tests.support.foreign_logs import csv_files_with_clock
from tests.support.made_flight import GRAVITY, TIME_S, flight
from tests.support.tables import table
from tests.support.written_logs import read_mapping

FLIP = np.array([1.0, -1.0, -1.0])
HEADER = [
    "ms",
    "n",
    "e",
    "d",
    "vn",
    "ve",
    "vd",
    "ax",
    "ay",
    "az",
    "p",
    "q",
    "r",
    "qx",
    "qy",
    "qz",
    "qw",
]
HEADER += ["ail", "ele", "rud", "thr", "mv"]
MAPPING = read_mapping("every_unit")


def write_csv(path: Path, log: FlightLog) -> Path:
    """Write a log as others would: NED, FRD, degrees, g, cm, ms, PWM, quaternions x, y, z, w."""
    ned = Rotation.from_quat(log["q"], scalar_first=True).as_quat(scalar_first=True) * [
        1.0,
        1.0,
        -1.0,
        -1.0,
    ]
    sticks = 1500.0 + 500.0 * log["u"] * [1.0, -1.0, -1.0, 1.0]
    p, v, f, w = (log[name] * FLIP for name in "pvfw")
    columns = [
        1e3 * log.time + 5000.0,
        100.0 * p,
        v,
        f / GRAVITY,
        np.rad2deg(w),
        ned[:, [1, 2, 3, 0]],
    ]
    columns += [sticks, 1e3 * log["v_bat"]]
    np.savetxt(path, np.column_stack(columns), "%.17g", ",", header=",".join(HEADER), comments="")
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory, truth) -> Path:
    """A folder with ``flight.csv`` of the first 3 s and its ``map.toml``."""
    out = tmp_path_factory.mktemp("csv")
    write_csv(out / "flight.csv", truth.select(slice(300)))
    (out / "map.toml").write_text(MAPPING)
    (out / "m.csv").write_text("file,rows\nflight.csv,7x")
    return out


def test_units_and_frames_come_out_ours(folder, truth):
    found = import_log(folder / "flight.csv", "csv", folder / "map.toml")
    np.testing.assert_allclose(found.log.time, TIME_S[:300], atol=1e-9)
    for name, values in truth.select(slice(300)).channels.items():
        sign = (
            np.sign(np.sum(found.log[name] * values, axis=1, keepdims=True)) if name == "q" else 1.0
        )
        np.testing.assert_allclose(sign * found.log[name], values, atol=1e-6, err_msg=name)
    assert found.craft == Craft((700.0, 600.0, 500.0), 0.5, (14.0, 16.8)) and found.problems == ()


def test_world_to_body_is_inverted(folder, tmp_path):
    direction = 'order = "xyzw"\ndirection = "world_to_body"'
    (tmp_path / "map.toml").write_text(MAPPING.replace('order = "xyzw"', direction))
    straight = import_log(folder / "flight.csv", "csv", folder / "map.toml", align=False).log
    inverted = import_log(folder / "flight.csv", "csv", tmp_path / "map.toml", align=False)
    turned = [Rotation.from_quat(log["q"], scalar_first=True) for log in (straight, inverted.log)]
    assert np.max((turned[0] * turned[1]).magnitude()) < 1e-6
    assert any("world to body" in problem for problem in inverted.problems)


def test_rows_are_chosen_and_files_become_segments(folder, tmp_path):
    for name in ("one.csv", "two.csv"):
        (tmp_path / name).write_bytes((folder / "flight.csv").read_bytes())
    (tmp_path / "list.csv").write_text("name,good\none.csv,100\ntwo.csv,60\n")
    rows = "[rows]\nevery = 2\nfrom_s = 0.2\n"
    manifest = '[rows.manifest]\nfile = "list.csv"\nkey = "name"\ncount = "good"\n'
    (tmp_path / "map.toml").write_text(MAPPING + rows + manifest)
    found = import_log([tmp_path / "one.csv", tmp_path / "two.csv"], "csv", tmp_path / "map.toml")
    np.testing.assert_allclose(found.log.time[:40], 0.01 * np.arange(20, 100, 2))
    assert found.log.segment.tolist() == [0] * 40 + [1] * 20
    assert [Path(source).name for source in found.sources] == ["one.csv", "two.csv"]
    (tmp_path / "list.csv").write_text("name,good\none.csv,100\n")
    with pytest.raises(LogError, match=r"list\.csv: columns name and good: two\.csv: missing"):
        import_log([tmp_path / "one.csv", tmp_path / "two.csv"], "csv", tmp_path / "map.toml")


@pytest.mark.parametrize(("old", "new", "message"), table("csv_mappings")["refused"])
def test_wrong_mappings_are_refused(folder, tmp_path, old, new, message):
    assert old in MAPPING
    (tmp_path / "map.toml").write_text(MAPPING.replace(old, new, 1))
    with pytest.raises(LogError, match=message):
        import_log(folder / "flight.csv", "csv", tmp_path / "map.toml")


@pytest.mark.parametrize(
    ("row", "change", "message"),
    [
        (
            4,
            lambda cells: [*cells[:3], "", *cells[4:]],
            r"row 3 \(line 5\), column d: found an empty cell",
        ),
        (0, lambda cells: ["ms", *cells[:-1]], r"column n: found .*|column ms: found 2 times"),
    ],
)
def test_wrong_cells_are_refused(folder, tmp_path, row, change, message):
    lines = (folder / "flight.csv").read_text().splitlines()
    lines[row] = ",".join(change(lines[row].split(",")))
    (tmp_path / "bad.csv").write_text("\n".join(lines))
    with pytest.raises(LogError, match=rf"bad\.csv: ({message})"):
        import_log(tmp_path / "bad.csv", "csv", folder / "map.toml")


def test_missing_and_unmapped_files_are_refused(folder, tmp_path):
    for path, format_name, mapping, message in (
        (
            folder / "flight.csv",
            "csv",
            tmp_path / "no.toml",
            r"no\.toml: found no such .*crazyflie_phoenix",
        ),
        (folder / "flight.csv", "csv", None, r"flight\.csv: no mapping names no columns"),
        (folder / "flight.csv", "mat", None, "format: found 'mat'"),
        ([], "csv", folder / "map.toml", "found no files"),
    ):
        with pytest.raises(LogError, match=message):
            import_log(path, format_name, mapping)


FILES = read_mapping("files")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            '"*_rc_0.csv"',
            '"*_rc_1.csv"',
            r"flight: found 0 files of the name \*_rc_1\.csv among x_gyro_0\.csv, x_rc_0",
        ),
        (
            '"*_rc_0.csv"',
            '"*.csv"',
            r"flight: found 2 files .*expected one by .*map\.toml: files\.rc",
        ),
        (
            '"*_rc_0.csv"',
            '"../*.csv"',
            r"files\.rc\.file: found '\.\./\*\.csv', expected the name of a file in",
        ),
        (
            '"gyro:p"',
            '"p"',
            r"map\.toml: rates: found p, expected file:column, where file is one of gyro, rc",
        ),
        (
            '"gyro:p"',
            '"gyro:x"',
            r"x_gyro_0\.csv: column x: found 0 times among t, p, q, r; expected once by",
        ),
        ('time = "ms"', 'time = "us"', r"x_rc_0\.csv: column us: found 0 times among ms, roll"),
        (
            "offset_s = 50.0",
            "",
            r"clock of u: found 49\.9995\d* to .*, that of w 100\.0+ to .*expected times in common",
        ),
    ],
)
def test_wrong_mappings_of_several_files_are_refused(tmp_path, old, new, message):
    path, mapping = csv_files_with_clock(tmp_path, 100.0 + 0.01 * np.arange(200))
    mapping.write_text(FILES.replace(old, new, 1))
    with pytest.raises(LogError, match=message):
        import_log(path, "csv", mapping)


def test_several_files_keep_their_own_clocks(tmp_path):
    path, mapping = csv_files_with_clock(tmp_path, 100.0 + 0.01 * np.arange(200))
    late = np.loadtxt(path / "x_rc_0.csv", delimiter=",", skiprows=1)[::2]
    late[:, 1] = np.linspace(-1.0, 1.0, len(late))
    np.savetxt(
        path / "x_rc_0.csv", late, "%.9f", ",", header="ms,roll,pitch,yaw,thrust", comments=""
    )
    log = import_log(path, "csv", mapping).log
    np.testing.assert_allclose(
        log["u"][:, 0], np.repeat(late[:, 1], 2)[: len(log)], atol=1e-8
    )  # held
    for folder, message in (
        (path / "x_rc_0.csv", "found no folder"),
        (tmp_path / "no", "found no folder"),
    ):
        with pytest.raises(LogError, match=message):
            import_log(folder, "csv", mapping)
    with pytest.raises(
        LogError, match=r"flight: found a folder, expected a file, or files\.NAME in"
    ):
        (tmp_path / "one.toml").write_text(read_mapping("clock"))
        import_log(path, "csv", tmp_path / "one.toml")


def test_nominal_model_hovers_where_the_nominal_craft_does():
    nominal = nominal_parameters()
    craft = Craft((60.0, 50.0, 40.0), 0.03, (3.0, 4.0)).nominal_model("a log")
    powers = np.array([1.0, 0.5, 0.25, 0.125])
    for share in (0.9, 1.0):  # of the highest voltage
        own, usual = 4.0 * share, 24.0 * share
        thrust = craft.thrust_coeffs @ np.array([*powers, own, 0.5 * own])
        expected = nominal.thrust_coeffs @ np.array([*powers, usual, 0.5 * usual])
        assert thrust / craft.m == pytest.approx(expected / nominal.m, rel=1e-5)
    assert craft.max_rate.tolist() == [60.0, 50.0, 40.0] and craft.m == 0.03
    with pytest.raises(LogError, match=r"a log: craft\.mass_kg: missing"):
        Craft((60.0, 50.0, 40.0), None, (3.0, 4.0)).nominal_model("a log")


def test_command_writes_log_details_and_model(folder, tmp_path, capsys):
    out, model = tmp_path / "log.npz", tmp_path / "model.json"
    arguments = ["import", folder / "flight.csv", "--format", "csv", "--map", folder / "map.toml"]
    main([str(part) for part in (*arguments, "--out", out, "--model-out", model)])
    output = capsys.readouterr().out
    assert "segment 0:" in output and "full stick 700, 600, 500 deg/s; mass 0.5 kg" in output
    details = json.loads((tmp_path / "log.import.json").read_text())
    assert details["sha256"] == load_log(out).sha256
    assert [Path(source).name for source in details["sources"]] == ["flight.csv"]
    assert load_model(model).m == 0.5 and load_model(model).max_rate.tolist() == [
        700.0,
        600.0,
        500.0,
    ]


@pytest.mark.slow
def test_command_keeps_clocks_if_asked(folder, tmp_path, capsys):
    late = write_csv(tmp_path / "late.csv", flight(TIME_S, 0.02))
    arguments = [
        "import",
        late,
        "--format",
        "csv",
        "--map",
        folder / "map.toml",
        "--out",
        tmp_path / "a.npz",
    ]
    for options, verdict, num_rows in (
        ([], "corrected", 1998),
        (["--keep-clocks"], "left as asked", 2000),
    ):
        main([str(part) for part in (*arguments, *options)])
        (line,) = (
            line for line in capsys.readouterr().out.splitlines() if line.startswith("clock of q")
        )
        assert "+20." in line and verdict in line
        assert abs(len(load_log(tmp_path / "a.npz")) - num_rows) <= 1
