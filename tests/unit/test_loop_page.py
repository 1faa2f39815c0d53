"""The pages of the loop's benchmark are made of the records beside them."""

import pytest

from benchmarks.loop.__main__ import main
from benchmarks.loop.page import false_names, read_records, write_page, write_records
from benchmarks.report import RESULTS


@pytest.mark.parametrize("name", ["loop", "beyond_loop"])
def test_page_is_what_its_records_give(name, tmp_path):
    about, results = read_records(RESULTS / f"{name}.jsonl")
    assert write_page(tmp_path / f"{name}.md", results, about)  # the target is met
    assert (tmp_path / f"{name}.md").read_text() == (RESULTS / f"{name}.md").read_text()
    assert (tmp_path / f"{name}.png").stat().st_size > 10_000


def test_records_come_back(tmp_path):
    about, results = read_records(RESULTS / "loop.jsonl")
    longer = [{**result, "cpu_s": 1.0} for result in results]  # what the page does not use
    write_records(tmp_path / "loop.jsonl", longer, about)
    assert read_records(tmp_path / "loop.jsonl") == (about, results)


def test_a_part_of_a_true_name_is_a_false_name():
    result = {"job": "1", "hidden": "windmill(gain 0.2) + rate_scale(roll 1.1)"}
    assert false_names([{**result, "causes": ["wind", "rate_scale", "tau_roll"]}]) == "1: wind"
    assert false_names([{**result, "causes": ["rate_scale"]}]) == "none"


def test_a_page_of_records_is_written_beside_them_only(tmp_path):
    records = RESULTS / "loop.jsonl"
    with pytest.raises(SystemExit, match="--page: found together with --redraw"):
        main(redraw=records, page=tmp_path / "other.md")
