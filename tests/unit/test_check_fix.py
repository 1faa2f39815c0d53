"""A corrected mapping reads a log as it was meant, and what it cannot say is left."""

import numpy as np
import pytest

from benchmarks.seams.flight import make_flight
from flytrack_sysid import import_log
from flytrack_sysid.check import Change, check_log
from flytrack_sysid.check.fix import fix_mapping
from flytrack_sysid.log import CHANNELS, LogError
from tests.support.slow import slow_but

CHANNELS_USED = ("u", "p", "v", "q", "w", "f", "v_bat")
MAPPING = """[time]
column = "t"
unit = "s"
[command]
columns = ["u_roll", "u_pitch", "u_yaw", "u_thrust"]
[position]
columns = ["p_x", "p_y", "p_z"]
unit = "m"
frame = "z_up"
[velocity]
columns = ["v_x", "v_y", "v_z"]
unit = "m/s"  # a comment that stays
frame = "z_up"
[specific_force]
columns = ["f_x", "f_y", "f_z"]
unit = "m/s^2"
frame = "flu"
[rates]
columns = ["w_x", "w_y", "w_z"]
unit = "rad/s"
frame = "flu"
[attitude]
quaternion = ["q_w", "q_x", "q_y", "q_z"]
order = "wxyz"
body = "flu"
world = "z_up"
[battery]
column = "v_bat"
unit = "V"
[craft]
max_rate_deg_s = [600, 600, 600]
mass_kg = 1.0
"""
WRONG = {  # words of the mapping that are wrong
    "order": [('order = "wxyz"', 'order = "xyzw"')],
    "body": [('body = "flu"', 'body = "frd"')],
    "direction": [('order = "wxyz"', 'order = "wxyz"\ndirection = "world_to_body"')],
    "gyro in deg/s": [('unit = "rad/s"', 'unit = "deg/s"')],
    "gyro frd": [
        ('"w_z"]\nunit = "rad/s"\nframe = "flu"', '"w_z"]\nunit = "rad/s"\nframe = "frd"')
    ],
    "force in g": [('unit = "m/s^2"', 'unit = "g"')],
    "velocity swapped": [('["v_x", "v_y", "v_z"]', '["v_y", "v_x", "v_z"]')],
    "position sign": [('unit = "m"\nframe', 'unit = "m"\nsigns = [1, -1, 1]\nframe')],
    "pitch stick": [('"u_thrust"]', '"u_thrust"]\nlow = [-1, 1, -1, -1]\nhigh = [1, -1, 1, 1]')],
    "gyro and velocity": [('unit = "rad/s"', 'unit = "deg/s"'), ('["v_x", "v_y"', '["v_y", "v_x"')],
}


@pytest.fixture(scope="module")
def csv_file(tmp_path_factory):
    """A flight as a CSV file."""
    log = make_flight(0, 15.0, "race").log
    names = [column for channel in CHANNELS_USED for column in CHANNELS[channel]]
    values = np.column_stack([log.time, *(log[channel] for channel in CHANNELS_USED)])
    path = tmp_path_factory.mktemp("flight") / "flight.csv"
    np.savetxt(path, values, delimiter=",", header=",".join(["t", *names]), comments="")
    return path


@pytest.fixture(scope="module")
def right(csv_file, tmp_path_factory):
    """The log by the right mapping."""
    return read(csv_file, tmp_path_factory.mktemp("right"), MAPPING)


def read(csv_file, folder, text):
    """Return the log that a mapping reads."""
    mapping = folder / "map.toml"
    mapping.write_text(text, encoding="utf-8")
    return import_log(csv_file, "csv", mapping, align=False).log


@pytest.mark.parametrize("wrong", slow_but(["order", "force in g", "gyro and velocity"], WRONG))
def test_a_wrong_word_is_corrected(tmp_path, csv_file, right, wrong):
    text = MAPPING
    for right_word, wrong_word in WRONG[wrong]:
        assert right_word in text
        text = text.replace(right_word, wrong_word, 1)
    found = check_log(read(csv_file, tmp_path, text))
    fix = fix_mapping(text, found.explanations[0])
    assert fix.left == () and len(fix.fixed) == len(WRONG[wrong])
    corrected = read(csv_file, tmp_path, fix.text)
    for channel in CHANNELS_USED:
        values = corrected[channel]
        if channel == "q":
            values = values * np.sign(np.sum(values * right["q"], axis=1, keepdims=True))
        np.testing.assert_allclose(values, right[channel], atol=1e-9)
    assert "# a comment that stays" in fix.text or "velocity" in wrong


def test_what_a_mapping_cannot_say_is_left():
    changes = (
        Change("q", "delay", 0.02),
        Change("q", "world", "-x -y z"),
        Change("u_rates", "curve", "actual"),
        Change("rows", "repeated", 0.1),
    )
    fix = fix_mapping(MAPPING, changes)
    assert fix == (MAPPING, (), changes)


def test_a_table_without_a_heading_of_its_own_is_refused():
    text = 'rates = {columns = ["a", "b", "c"], unit = "rad/s", frame = "flu"}\n'
    with pytest.raises(LogError, match="rates: expected a line"):
        fix_mapping(text, [Change("w", "axes", "x -y -z")])
