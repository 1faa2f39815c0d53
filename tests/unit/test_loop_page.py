"""The pages of the loop's benchmark are made of the records beside them."""

import json

import pytest

from benchmarks.loop.page import read_records, write_page, write_records
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
    with (tmp_path / "loop.jsonl").open() as lines:
        assert all(json.loads(line) for line in lines)
