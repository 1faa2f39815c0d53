"""The page of benchmarks.adapt, of lines of which many are incomplete."""

import pytest

from benchmarks import adapt, report

RACED = {"success": 1.0, "flying_lap_s": 4.0}
LOST = {"success": 0.0, "flying_lap_s": None}
STAMP = {"seconds": 10.0, "seed": 1, "commit": "abc", "machine": "a machine"}
WHOLE = {
    "hidden": "wind(v_x 2)",
    "flights": 5,
    "cpu_s": 40.0,
    "motion_found": "euler",
    "named": ["wind", "rotor_drag"],
    "verdict": "causes_found",
    "is_new": True,
    "expected_lap_s": [3.9, 4.1],
    "entries": {"nothing": LOST, "adapted": RACED, "refitted base": LOST, "limit": RACED},
}


def line(kind, number, **measured):
    return {"kind": kind, "number": number, "motion": "handout", **STAMP, **measured}


@pytest.fixture
def written(tmp_path, monkeypatch):
    """Return the page of some lines."""
    monkeypatch.setattr(report, "RESULTS", tmp_path)

    def write(*lines):
        adapt.write_page(list(lines))
        return (tmp_path / "adapt.md").read_text()

    return write


def test_a_law_of_the_policys_model_is_not_invented(written):
    """robust's model has rotor drag, and the plant has none: the name is right."""
    invented = {**WHOLE, "named": ["wind", "ground_effect"]}
    page = written(line("plant", 1, **WHOLE), line("plant", 2, **invented))
    assert "that neither they nor the policy's model have | none | 1 of 2 |" in page
    assert "| flying lap, adapted over limit, median (all) | 1.05 | 1.000 (1.000 to 1.000)" in page


def test_lines_that_lack_something(written):
    no_limit = {**WHOLE, "entries": {"nothing": LOST, "adapted": LOST, "refitted base": LOST}}
    refused = {"hidden": "", "flights": 1, "entries": {"nothing": LOST}, "refused": "a hover"}
    page = written(
        line("plant", 1, **no_limit),
        line("plant", 2, **refused),
        line("plant", 3, error="crashed"),
        line("rivals", 1, entries={"randomised 10 %": RACED}),
        line("residual", 1, entries={"residual network": RACED}),
        line("rivals", 2, error="crashed"),
        line("unchanged", 0, error="crashed"),
    )
    assert (
        "2 of 24 pairs of plant and motion were flown, 1 of them refused as a log. Errors: 3."
        in page
    )
    assert "99 % of starts finish: residual network |  | 1 of 1 |" in page
    assert "a hover" in page and "100.0%, 4.000 s" in page
    assert "| flying lap, adapted over limit, median (all) | 1.05 | none | 0 |" in page


def test_firmware_and_other_lengths_have_tables_of_their_own(written):
    raced = {**WHOLE, "simulated_lap_s": 3.96, "entries": {"nothing": LOST, "adapted": RACED}}
    refused = {"hidden": "curved", "flights": 1, "entries": {"nothing": LOST}, "refused": "a hover"}
    page = written(
        line("plant", 1, **WHOLE),
        {**line("plant", 1, **raced), "seconds": 5.0},
        {**line("plant", 2, **refused), "seconds": 5.0},
        line("firmware", 0, **raced),
        line("firmware", 2, **refused),
        line("size", 1, **{**raced, "hidden": "12.6 V"}),
    )
    assert "1 of 24 pairs of plant and motion" in page
    assert "| 5 | 1 | 1 of 2 | 1 of 1 | 1 | 40 | abc |" in page
    assert "| 10 | 1 | 1 of 1 | 1 of 1 | 0 | 40 | abc |" in page
    assert "| 0.0%, - | 100.0%, 4.000 s | +1.01% | 40.0 |" in page
    assert "| 12.6 V | causes_found | wind, rotor_drag |" in page
    assert "| curved | a hover | - | 0.0%, - | - | - | - |" in page


def test_rivals_are_compared_by_races_a_second():
    half = {**WHOLE, "entries": {**WHOLE["entries"], "nothing": {**RACED, "success": 0.5}}}
    assert adapt.speed_ratio(half, "nothing") == 0.5
    assert adapt.speed_ratio(WHOLE, "refitted base") == 0.0
    text, count = adapt.describe_ratios([0.0, 0.0, 0.5, 0.6, 0.7, 0.8, 1.0, 9.0])
    assert text.startswith("0.650 (") and count == 8
