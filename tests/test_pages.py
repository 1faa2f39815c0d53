"""The generated documentation: what is committed is what the code says."""

import re
from pathlib import Path

import pytest

from docs.pages import DOCS, pages
from flytrack_env.effects import EFFECTS
from flytrack_env.registration import ENVIRONMENTS

PAGES = pages()


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_committed_pages_are_what_the_code_says(path: Path) -> None:
    assert path.read_text(encoding="utf-8") == PAGES[path], "run `python -m docs.pages`"


def test_every_id_and_effect_has_its_page() -> None:
    assert {path.stem for path in (DOCS / "envs").glob("*.md")} == set(ENVIRONMENTS)
    effects = PAGES[DOCS / "effects.md"]
    assert re.findall(r"^## `(\w+)`$", effects, re.MULTILINE) == [effect.name for effect in EFFECTS]


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


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(path: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", PAGES[path]):
        assert (path.parent / target).exists(), target
