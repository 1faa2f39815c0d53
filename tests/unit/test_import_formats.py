"""What holds for every format: flights come back, whole or cut off, and other files are named."""

import re
import tarfile
from dataclasses import replace

import numpy as np
import pytest

from flytrack_sysid import LogError, import_log
from flytrack_sysid.importing.file_kinds import identify
from flytrack_sysid.importing.importer import FORMATS
from tests.support.foreign_logs import WRITERS, flying
from tests.support.grounded_flights import (
    LANDING_S,
    STEP_S,
    TAKE_OFF_S,
    stands_flies_and_lands,
)
from tests.support.slow import slow_but
from tests.support.tables import table
from tests.support.written_logs import npz_bytes

ATTITUDE_AND_PLACE = {"ULog": set("pvq"), "DataFlash": set("pvq")}
# Whole numbers of 0.001 of the throttle or deg/s, 0.01 V, and 1/2048 g.
RESOLUTION = {"blackbox": {"u": 1e-3, "w": 0.009, "f": 0.0025, "v_bat": 0.0051}}


def test_every_format_has_a_writer():
    assert {form for form, _ in WRITERS.values()} == set(FORMATS)


@pytest.mark.parametrize("kind", WRITERS)
def test_a_flight_comes_back(kind, truth, tmp_path):
    form, write = WRITERS[kind]
    truth = truth.select(slice(500))
    path, mapping = write(tmp_path, replace(truth, time=truth.time + 1.0))
    imported = import_log(path, form, mapping, align=False)
    log, rows = imported.log, np.searchsorted(truth.time, imported.log.time - 1e-6)
    assert imported.problems == () and log.origin == "measured"
    assert len(log) >= len(truth) - 1
    assert set(log.channels) == {"u", "w", "f", "v_bat"} | ATTITUDE_AND_PLACE.get(kind, set())
    for name, values in log.channels.items():
        tolerance = RESOLUTION.get(kind, {}).get(name, 1e-5)
        expected = truth[name][rows]
        if name == "q":
            expected = expected * np.sign(np.sum(expected * values, axis=1, keepdims=True))
        np.testing.assert_allclose(values, expected, atol=tolerance, err_msg=name)
    if form in ("usd", "bag", "csv"):
        assert imported.craft.max_rate_deg_s == (500.0, 500.0, 500.0)


@pytest.mark.parametrize("kind", slow_but(["ULog", "CSV"], WRITERS))
def test_ground_is_left_out_and_counted(kind, tmp_path):
    truth = stands_flies_and_lands()
    form, write = WRITERS[kind]
    path, mapping = write(tmp_path, truth)
    mapping = mapping or tmp_path / "map.toml"
    text = mapping.read_text() if mapping.exists() else ""

    def imported(rows):
        mapping.write_text(f"{text}\n[rows]\n{rows}\n")
        result = import_log(path, form, mapping, align=False)
        return result.log, " ".join(result.notes)

    flight, notes = imported("")
    assert flight.time[[0, -1]] == pytest.approx([TAKE_OFF_S, LANDING_S], abs=0.6)  # two blocks
    assert np.diff(flight.time).max() < 2.0 * STEP_S  # nothing in between is lost
    whole, notes_on_whole = imported('on_ground = "keep"')
    assert len(whole) >= len(truth) - 1 and "on the ground" not in notes_on_whole
    left_out = f"{len(whole) - len(flight)} of {len(whole)} rows left out: on the ground"
    assert left_out in notes
    with pytest.raises(LogError, match=r"nothing flies: on the ground in all \d+ rows; rows.on_gr"):
        imported(f"to_s = {TAKE_OFF_S - 1.0}")


# --- Logs without their last tenth, as when the battery was pulled --------------------------------

NUM_ROWS = 1000
CUT_OFF = table("cut_off_logs")


@pytest.mark.parametrize("kind", WRITERS)
def test_whole_rows_of_a_log_that_is_cut_off_are_used_or_it_is_refused(kind, tmp_path):
    form, write = WRITERS[kind]
    path, mapping = write(tmp_path, flying(NUM_ROWS))
    largest = max(
        [path] if path.is_file() else path.iterdir(), key=lambda file: file.stat().st_size
    )
    content = largest.read_bytes()
    end = int(0.9 * len(content)) - 11  # within a message of every format
    if form == "csv":
        end = content.rindex(b"\n", 0, end) + 4  # within the first cell of a row
    largest.write_bytes(content[:end])
    if kind in CUT_OFF["refused"]:
        with pytest.raises(LogError, match=CUT_OFF["refused"][kind]):
            import_log(path, form, mapping)
        return
    imported = import_log(path, form, mapping, align=False)
    min_rows, note = CUT_OFF["used"][kind]
    assert min_rows <= len(imported.log) < NUM_ROWS
    assert re.search(note, " ".join(imported.notes))


# --- Files of other kinds -------------------------------------------------------------------------


OTHERS = {
    "ZIP": npz_bytes({"a": np.zeros(3)}),
    "TAR": tarfile.TarInfo("a").tobuf(),
    "empty": b"",
    "MAVLink": bytes(8) + b"\xfd\x09\x00\x00",
    "no known kind": b"\x00\xff\x10\x80" * 9,
    "text": "Größe, Maße\n".encode() * 60,
}


@pytest.mark.parametrize("kind", OTHERS)
def test_other_kinds_are_named(kind):
    assert kind in str(identify(OTHERS[kind][:512]))


@pytest.mark.parametrize("kind", [kind for kind in WRITERS if kind != "CSV files"])
def test_logs_of_other_formats_are_refused_with_the_format_that_reads_them(kind, tmp_path):
    form, write = WRITERS[kind]
    path, _ = write(tmp_path, flying())
    assert identify(path.read_bytes()).format == form
    for other, (other_form, write_other) in WRITERS.items():
        if other_form != form and other != "CSV files":
            _, mapping = write_other(tmp_path, flying())
            with pytest.raises(LogError, match=rf"\(--format {form} reads it\), expected"):
                import_log(path, other_form, mapping)
