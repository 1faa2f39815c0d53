"""The tutorials run as they are written, and end where they say."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from docs.pages import notebook_page
from flytrack_env import find_problems, load_model, load_track
from flytrack_env.rollout import load_rollout
from tests.support.pages import DOCS, run_examples

pytestmark = pytest.mark.slow


def tutorial(name):
    """Return a tutorial's text."""
    return (DOCS / "tutorials" / f"{name}.md").read_text(encoding="utf-8")


def test_algorithm_improves_its_return(tmp_path, monkeypatch):
    text = (DOCS / "algorithm.md").read_text(encoding="utf-8")
    names = run_examples(text, tmp_path, monkeypatch)
    assert names["after"] > names["before"] + 0.3


def test_track_is_corrected_and_flown(tmp_path, monkeypatch):
    names = run_examples(tutorial("track"), tmp_path, monkeypatch)
    assert [problem.demand for problem in names["problems"]] == ["bounds"]
    assert not find_problems(load_track(tmp_path / "square.toml"))
    states, _ = load_rollout(tmp_path / "square.npy")
    assert len(states) == 100 and states[-1, 2] > states[0, 2] + 0.5
    assert (tmp_path / "square_top.png").stat().st_size > 10_000


def test_black_box(tmp_path, monkeypatch):
    names = run_examples(tutorial("black_box"), tmp_path, monkeypatch)
    with pytest.raises(names["blackbox"].BlackBoxError, match="signature: found"):
        names["blackbox"].load("wrong.bin")
    assert names["rewards"].shape == (8,) and len(names["log"]) > 4000


def test_contradiction_is_found_and_corrected(tmp_path, monkeypatch):
    names = run_examples(tutorial("contradiction"), tmp_path, monkeypatch)
    assert not names["fixed"].problems


def test_better_policy(tmp_path, monkeypatch):
    names = run_examples(tutorial("better_policy"), tmp_path, monkeypatch)
    loop, errors = (
        names["loop"],
        names["errors_of"](names["found"].extended, names["loop"].held_out),
    )
    assert errors.position_m["0.5"] < loop.before.errors.position_m["0.5"]
    assert loop.after.errors.position_m["0.5"] < loop.before.errors.position_m["0.5"]
    files = {path.name for path in (tmp_path / "loop").iterdir()}
    assert {"loop.json", "comparison_top.png", "after_plant.npy", "race.npz", "history"} <= files


def test_notebook(tmp_path, monkeypatch):
    def shown(path="", filename=""):
        return Path(path or filename).stat().st_size

    display = SimpleNamespace(Image=shown, HTML=shown)  # of Jupyter, which the tests do without
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    run_examples(notebook_page("quick_start"), tmp_path, monkeypatch)
    assert load_model(tmp_path / "runs" / "diagnosis" / "extended_model.json").effect("rotor_drag")
