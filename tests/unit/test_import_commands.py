"""Commands of attitude setpoints and of motors, and the shipped mappings."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytrack_sysid import LogError, import_log
from flytrack_sysid.importing import load_mapping
from flytrack_sysid.importing.mapping import SHIPPED
from tests.support.tables import table
from tests.support.written_logs import read_mapping, write

NUM_ROWS, STEP_S = 1500, 0.01
GAINS = np.array([6.0, 5.0, 2.0])
MAPPING = read_mapping("angle_setpoints")
WITH_GAINS = MAPPING.replace("signs", "gain = [6, 5, 2]\nsigns")


def flight():
    """Return columns of rates that follow attitude errors times 6, 5, 2 with a lag of 40 ms."""
    rng = np.random.default_rng(0)
    targets = np.repeat(0.25 * rng.normal(size=(NUM_ROWS // 30, 3)), 30, axis=0)
    angles, rates = np.zeros((NUM_ROWS, 3)), np.zeros((NUM_ROWS, 3))
    for row in range(1, NUM_ROWS):
        target_rates = GAINS * (targets[row - 1] - angles[row - 1])
        rates[row] = rates[row - 1] + (target_rates - rates[row - 1]) * STEP_S / 0.04
        angles[row] = angles[row - 1] + STEP_S * rates[row]
    setpoints, motors = np.rad2deg(targets) * [1, -1, 1], 40_000.0 + 1000.0 * np.arange(4)
    columns = np.column_stack([setpoints, angles, rates, np.tile(motors, (NUM_ROWS, 1))])
    columns[:15, -1] = 65535.0
    names = ["sr", "sp", "sy", "r", "p", "y", "wx", "wy", "wz", "m0", "m1", "m2", "m3"]
    named = dict(zip(names, columns.T, strict=True))
    return {"t": STEP_S * np.arange(NUM_ROWS), **named, "pwm": named["m0"]}


def read(folder, mapping, columns=None):
    """Return the import of a CSV file."""
    write(folder / "flight.csv", flight() if columns is None else columns)
    (folder / "map.toml").write_text(mapping)
    return import_log(folder / "flight.csv", "csv", folder / "map.toml", align=False)


def test_attitude_setpoints_become_rates_by_given_gains(tmp_path):
    columns, imported = flight(), read(tmp_path, f"{WITH_GAINS}voltage_v = [14, 16.8]\n")
    assert imported.log.stated_voltage_v == (14.0, 16.8)
    errors = np.deg2rad(columns["sr"]) - columns["r"], -np.deg2rad(columns["sp"]) - columns["p"]
    for axis, error in enumerate(errors):
        expected = np.clip(GAINS[axis] * error / np.deg2rad(300.0), -1.0, 1.0)
        np.testing.assert_allclose(imported.log["u"][:, axis], expected, atol=1e-6)
    assert imported.log["u"][:, 3] == pytest.approx(2 * 40_000 / 65535 - 1)
    assert "times gains of 6, 5, 2 1/s (given)" in " ".join(imported.notes)


def test_attitude_gains_are_identified_or_asked_for(tmp_path):
    notes = " ".join(read(tmp_path, MAPPING).notes)
    gains = re.search(
        r"times gains of (\S+), (\S+), (\S+) 1/s \(roll, pitch, yaw identified", notes
    )
    assert [float(text) for text in gains.groups()] == pytest.approx(GAINS, rel=0.1)
    columns = {**flight(), "wz": np.random.default_rng(1).normal(size=NUM_ROWS)}
    with pytest.raises(
        LogError, match=r"attitude_command\.gain: cannot be identified for yaw: .*; state it"
    ):
        read(tmp_path, MAPPING, columns)
    some = read(tmp_path, MAPPING.replace("signs", "gain = [0, 0, 2]\nsigns"), columns)
    assert "2 1/s (roll, pitch identified" in " ".join(some.notes)


def test_motors_replace_the_thrust_command_and_show_saturation(tmp_path):
    motors = '[motors]\ncolumns = ["m0", "m1", "m2", "m3"]\nlow = 0\nhigh = 65535\n'
    imported = read(tmp_path, WITH_GAINS + motors)
    assert "a motor at its upper end in 1.00% of the rows" in " ".join(imported.notes)
    assert imported.log["u"][-1, 3] == pytest.approx(2 * 40_000 / 65535 - 1)
    imported = read(tmp_path, f"{WITH_GAINS}{motors}as_thrust = true\n")
    assert imported.log["u"][-1, 3] == pytest.approx(2 * 41_500 / 65535 - 1)
    torque = "torque_n_m = [[-1, -1, 1, 1], [0, 0, 0, 0], [0, 0, 0, 0]]\nrate_gain = [0.1, 1, 1]\n"
    log = read(tmp_path, WITH_GAINS + motors + torque).log
    expected = flight()["wx"] + (4000.0 / 65535.0) / 0.1
    np.testing.assert_allclose(log["u"][20:, 0] * np.deg2rad(300.0), expected[20:], atol=1e-6)


def test_only_the_longest_stretch_in_the_air_is_used(tmp_path):
    height = np.repeat([0.0, 1.0, 0.0, 1.0, 0.0], 300)
    height[700:720] = 1.0  # a hop
    place = (
        '[position]\ncolumns = ["n", "e", "h"]\nunit = "m"\nframe = "z_up"\n[rows]\nabove_m = 0.2\n'
    )
    columns = {**flight(), "n": 0 * height, "e": 0 * height, "h": height}
    log = read(tmp_path, WITH_GAINS + place, columns).log
    assert len(log) == 300 and log.time[[0, -1]] == pytest.approx([3.0, 5.99])


@pytest.mark.parametrize(("old", "new", "message"), table("command_mappings")["refused"])
def test_what_makes_no_commands_is_refused(tmp_path, old, new, message):
    with pytest.raises(LogError, match=message):
        read(tmp_path, MAPPING.replace(old, new, 1))


def test_clipped_commands_are_counted(tmp_path):
    rows = np.array([[0.0] * 5, [0.01, 0.0, 0.0, 0.0, 0.5], [0.02, -1.25, 0.0, 0.0, 0.5]])
    clipped = '[time]\ncolumn="t"\nunit="s"\n[command]\ncolumns=["a","b","c","d"]\nclip=true\n'
    imported = read(tmp_path, clipped, dict(zip("tabcd", rows.T, strict=True)))
    assert imported.log["u"][2, 0] == -1.0
    assert "commands clipped to [-1, 1] in 1 of 3 rows" in imported.notes[0]


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_mappings_are_valid(path):
    assert load_mapping(path.stem).source == str(path)


def test_tii_ratm_columns_become_a_flight(tmp_path):
    """By the published header and a row written by hand; the dataset's own rows are not at hand."""
    mapping = load_mapping("tii_ratm")
    turn = Rotation.from_euler("ZYX", [0.5, 0.2, -0.1])
    values = {column: 0.0 for channel in mapping.channels for column in channel.columns}
    matrix = turn.as_matrix().T.ravel()  # by columns
    values |= {f"drone_rot[{number}]": value for number, value in enumerate(matrix)}
    values |= {"channels_roll": 1750, "channels_pitch": 1500, "channels_yaw": 1750}
    values |= {"channels_thrust": 1250, "accel_z": 9.81, "vbat": 24.0}
    columns = {name: np.full(200, float(value)) for name, value in values.items()}
    columns["elapsed_time"] = 0.002 * np.arange(200)
    log = read(tmp_path, 'extends = "tii_ratm"\n', columns).log
    assert log["u"][0] == pytest.approx([0.5, 0.0, -0.5, -0.5])  # yaw to the right is negative
    np.testing.assert_allclose(log["q"][0], turn.as_quat(scalar_first=True), atol=1e-6)
