"""The generated documentation: what is committed is what the code says."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docs.pages import DOCS, pages
from flytrack_env.effects import EFFECTS, Effect, effect_of
from flytrack_env.references import KINDS, shipped_reference
from flytrack_env.registration import ENVIRONMENTS
from flytrack_env.tracks import available_tracks, build_course, load_track

PAGES = pages()


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_committed_pages_are_what_the_code_says(path: Path) -> None:
    assert path.read_text(encoding="utf-8") == PAGES[path], "run `python -m docs.pages`"


def test_every_id_effect_and_track_has_its_page() -> None:
    assert {path.stem for path in (DOCS / "envs").glob("*.md")} == set(ENVIRONMENTS)
    assert {path.stem for path in (DOCS / "effects").glob("*.md")} == {effect.name for effect in EFFECTS}
    assert {path.stem for path in (DOCS / "tracks").glob("*.md")} == set(available_tracks())
    rows = re.findall(r"^\| \[`(\w+)`\]\(effects/(\w+)\.md\)", PAGES[DOCS / "effects.md"], re.MULTILINE)
    assert rows == [(effect.name, effect.name) for effect in EFFECTS]


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_an_effect_page_has_the_law_and_every_parameter(effect: Effect) -> None:
    text = PAGES[DOCS / "effects" / f"{effect.name}.md"]
    assert f"```text\n{effect.equation}\n```" in text
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", text, re.MULTILINE))
    neutral = effect.parameters()
    for name, bounds in effect.ranges.items():
        cells = rows[name].split(" | ")
        assert cells[:3] == [bounds.unit, f"{getattr(neutral, name):g}", f"{bounds.low:g} to {bounds.high:g}"]
    assert all(f"`{channel}`" in text.partition("## In a flight log")[2] for channel in effect.needs)


@pytest.mark.parametrize("name", available_tracks())
def test_a_track_page_has_every_gate_and_the_references(name: str) -> None:
    text, track = PAGES[DOCS / "tracks" / f"{name}.md"], load_track(name)
    gates = text.partition("## Gates")[2].partition("## Records")[0]
    rows = [line.strip("| ").split(" | ") for line in re.findall(r"^\| \d.*$", gates, re.MULTILINE)]
    assert [row[0] for row in rows] == [str(gate.id) for gate in track.gates]
    for row, forward in zip(rows, np.stack(build_course(track).gates.forward, axis=-1), strict=True):
        heading = np.deg2rad(float(row[5]))
        assert np.dot(forward[:2], (np.cos(heading), np.sin(heading))) > 0.999
    for model_name in ("nominal", "black_box"):
        for kind in KINDS:
            assert f"| {shipped_reference(name, kind, model_name).time_s:.3f} |" in text


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_a_page_has_every_section(env_id: str) -> None:
    text = PAGES[DOCS / "envs" / f"{env_id}.md"]
    headings = re.findall(r"^## (.*)$", text, re.MULTILINE)
    wanted = [
        "Action",
        "Observation",
        "Reward",
        "Start",
        "End of an episode",
        "Info",
        "Arguments",
        "Versions",
    ]
    assert [heading for heading in headings if heading != "What is different"] == wanted
    assert ("What is different" in headings) == bool(ENVIRONMENTS[env_id].wrappers)


@pytest.mark.parametrize(
    "path", [path for path in PAGES if path.parent.name in ("effects", "tracks")], ids=lambda p: p.stem
)
def test_a_page_shows_python_that_runs(path: Path) -> None:
    code = "\n".join(re.findall(r"^```python\n(.*?)^```", PAGES[path], re.MULTILINE | re.DOTALL))
    names: dict[str, Any] = {}
    exec(compile(code, path.name, "exec"), names)
    names["env"].check_params(names["params"])
    if path.parent.name == "effects":
        assert effect_of(names["ranges"].low[0]).name == effect_of(names["effect"]).name == path.stem
