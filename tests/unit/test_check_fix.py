"""A corrected mapping reads a log as it was meant, and what it cannot say is left."""

import pytest

from benchmarks.seams.mapped import MAPPING, import_csv, is_equal, write_csv
from flytrack_sysid.check import Change, check_log
from flytrack_sysid.check.fix import fix_mapping
from flytrack_sysid.log import LogError
from tests.support.seam_flights import seam_flight
from tests.support.slow import slow_but
from tests.support.tables import table

WRONG = table("wrong_mappings")


@pytest.fixture(scope="module")
def csv_file(tmp_path_factory):
    """A flight as a CSV file."""
    path = tmp_path_factory.mktemp("flight") / "flight.csv"
    write_csv(path, seam_flight("race").log.select(slice(1500)))
    return path


@pytest.mark.parametrize("wrong", slow_but(["direction", "gyro and velocity"], WRONG))
def test_a_wrong_word_is_corrected(csv_file, wrong):
    text = MAPPING
    for right_word, wrong_word in WRONG[wrong]:
        assert right_word in text
        text = text.replace(right_word, wrong_word, 1)
    found = check_log(import_csv(csv_file, text))
    fix = fix_mapping(text, found.explanations[0])
    assert fix.left == () and len(fix.fixed) == len(WRONG[wrong])
    assert is_equal(import_csv(csv_file, fix.text), import_csv(csv_file, MAPPING))
    assert all(comment in fix.text for comment in ("# a comment that stays", "# by the manual"))


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
