"""The page of benchmarks.adapt."""

from benchmarks import adapt, report

RACED = {"success": 1.0, "flying_lap_s": 4.0}
LOST = {"success": 0.0, "flying_lap_s": None}
WHOLE = {
    "kind": "plant",
    "number": 1,
    "motion": "handout",
    "seconds": 10.0,
    "seed": 1,
    "commit": "abc",
    "machine": "a machine",
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


def test_a_law_of_the_policys_model_is_not_invented(tmp_path, monkeypatch):
    """robust's model has rotor drag, and the plant has none: the name is right."""
    monkeypatch.setattr(report, "RESULTS", tmp_path)
    adapt.write_page([WHOLE, {**WHOLE, "number": 2, "named": ["wind", "ground_effect"]}])
    page = (tmp_path / "adapt.md").read_text()
    assert "that neither they nor the policy's model have | none | 1 of 2 |" in page
    assert "| flying lap, adapted over limit, median (all) | 1.05 | 1.000 (1.000 to 1.000)" in page


def test_rivals_are_compared_by_races_a_second():
    half = {**WHOLE, "entries": {**WHOLE["entries"], "nothing": {**RACED, "success": 0.5}}}
    assert adapt.speed_ratio(half, "nothing") == 0.5
    assert adapt.speed_ratio(WHOLE, "refitted base") == 0.0
    text, count = adapt.describe_ratios([0.0, 0.0, 0.5, 0.6, 0.7, 0.8, 1.0, 9.0])
    assert text.startswith("0.650 (") and count == 8
