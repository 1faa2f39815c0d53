"""Every relative link and anchor of every Markdown page leads somewhere."""

import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^`{3,}.*?^`{3,}$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
PAGES = sorted(
    [*ROOT.glob("*.md"), *(path for folder in ("docs", "blackbox") for path in (ROOT / folder).rglob("*.md"))]
)


def slug(heading: str) -> str:
    """Return the anchor of a heading, as GitHub and the site make it."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
    return re.sub(r"[^\w\- ]", "", text.strip().lower()).replace(" ", "-")


@cache
def anchors(path: Path) -> frozenset[str]:
    """Return the anchors of a page's headings; those that are there twice are none."""
    text = BLOCK.sub("", path.read_text(encoding="utf-8"))
    slugs = [slug(heading) for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE)]
    return frozenset(name for name in slugs if slugs.count(name) == 1)


def broken(path: Path, text: str) -> list[str]:
    """Return the relative links of a page's text that lead nowhere."""
    found = []
    for target in LINK.findall(BLOCK.sub("", text)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        linked = (path.parent / name).resolve() if name else path
        is_there = linked.exists() and linked.is_relative_to(ROOT)
        if not is_there or (anchor and (linked.suffix != ".md" or anchor not in anchors(linked))):
            found.append(target)
    return found


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_and_anchors_lead_somewhere(path: Path) -> None:
    assert broken(path, path.read_text(encoding="utf-8")) == []


def test_what_is_broken_is_found() -> None:
    page = ROOT / "docs" / "index.md"
    text = "[a](nowhere.md) [b](faq.md#nowhere) [c](quick_start.md) [d](https://example.org)\n```\n[e](no.md)\n```\n"
    assert broken(page, text) == ["nowhere.md", "faq.md#nowhere"]
    assert len(PAGES) > 80 and slug("`diagnosis.json`, and *more*") == "diagnosisjson-and-more"


def test_every_page_is_in_the_navigation() -> None:
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    nav = re.findall(r"^ +- (?:[^#:\n]*: )?(\S+\.md)$", text[text.index("\nnav:") :], re.MULTILINE)
    outside = [name.removeprefix("repository/") for name in nav if name.startswith("repository/")]
    inside = [name for name in nav if not name.startswith("repository/")]
    pages = [str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")]
    assert sorted(inside) == sorted(pages) and len(set(nav)) == len(nav)
    assert all((ROOT / name).is_file() for name in outside) and outside
