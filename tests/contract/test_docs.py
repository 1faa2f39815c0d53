"""The documentation agrees with the code: API reference, generated pages, examples."""

import ast
import importlib
import re

import numpy as np
import pytest

from docs.effect_pages import effect_page
from docs.pages import site_pages
from docs.threshold_pages import modules, parse_constants
from docs.track_pages import gate_rows, track_page
from flytrack_env.effects import EFFECTS
from flytrack_env.tracks import available_tracks, build_course, load_track
from tests.support.pages import BLOCK, DOCS, ROOT, examples, run_examples
from tests.support.slow import slow_but

PACKAGES = ("flytrack_env", "flytrack_sysid", "flytrack_loop", "flytrack_bench", "baselines")
REFERENCE = {
    module
    for path in (DOCS / "api").glob("*.md")
    for module in re.findall(r"^::: ([\w.]+)$", path.read_text(), re.MULTILINE)
}
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
READ_FIRST = [ROOT / "README.md", DOCS / "results/index.md"]
CLAIM = re.compile(r"^(- \*\*|\| \[).*?(?=^- |^\| |^$)", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"(?<![\w.,-])\d+(?:[.,]\d+)*(?:e\+\d+)?(?![\w-])")
FAST = "wrappers.md"  # one page's examples run in the fast tests
RUN = (
    FAST,
    "environment.md",
    "effects.md",
    "gymnasium.md",
    "recordings.md",
    "identification.md",
    "real_logs.md",
    "check.md",
    "camera.md",
    "diagnosis.md",
    "quick_start.md",
    "faq.md",
    "exercise.md",
    "../README.md",
)


def test_every_public_package_is_in_the_reference():
    files = [path for package in PACKAGES for path in (ROOT / package).rglob("__init__.py")]
    packages = {".".join(path.relative_to(ROOT).parent.parts) for path in files}
    public = {name for name in packages if hasattr(importlib.import_module(name), "__all__")}
    assert public <= REFERENCE


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_what_a_page_imports_is_public(path):
    for node in ast.walk(ast.parse(examples(path.read_text(encoding="utf-8")))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in PACKAGES:
            module = importlib.import_module(node.module)
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                is_listed = name in REFERENCE or node.module in REFERENCE
                assert is_listed, f"{node.module}: not in the reference"
                if name in REFERENCE and not hasattr(module, alias.name):
                    importlib.import_module(name)  # a module is no attribute before
                assert hasattr(module, alias.name), f"{node.module} has no {alias.name}"


def claims(path):
    """Return the lines of a page that link to a result, each with the text of the result's page."""
    lines = []
    for match in CLAIM.finditer(path.read_text(encoding="utf-8")):
        (target,) = re.findall(r"\]\((?:docs/results/)?(\w+\.md)\)", match[0])
        page = (DOCS / "results" / target).read_text(encoding="utf-8")
        cells = match[0].split("|")[2:4] if match[0].startswith("|") else [match[0].split("](")[0]]
        lines.append((" ".join(cells), page))
    return lines


@pytest.mark.parametrize("path", READ_FIRST, ids=lambda path: path.name)
def test_a_number_of_a_claim_is_on_the_page_that_it_links_to(path):
    assert len(claims(path)) >= 5
    for claim, page in claims(path):
        numbers = set(NUMBER.findall(claim))
        assert numbers, claim
        assert numbers <= set(NUMBER.findall(page)), (claim, numbers - set(NUMBER.findall(page)))


@pytest.mark.parametrize("page", slow_but([FAST], RUN))
def test_examples_run(page, tmp_path, monkeypatch):
    run_examples((DOCS / page).read_text(encoding="utf-8"), tmp_path, monkeypatch)


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_page_of_an_effect_has_its_parameters_and_python_that_runs(effect, tmp_path, monkeypatch):
    text = effect_page(effect)
    assert "<math" in text and all(f"\n| `{parameter}` |" in text for parameter in effect.ranges)
    names = run_examples(text, tmp_path, monkeypatch)
    names["env"].check_params(names["params"])


@pytest.mark.parametrize("name", available_tracks())
def test_page_of_a_track_has_the_headings_of_its_gates(name):
    track = load_track(name)
    forward = np.stack(build_course(track).gates.forward, axis=-1)[:, :2]
    headings = np.deg2rad([heading_deg for _, _, heading_deg, _ in gate_rows(track)])
    np.testing.assert_allclose(
        forward, np.stack([np.cos(headings), np.sin(headings)], -1), atol=1e-5
    )
    assert BLOCK.search(track_page(name)) and (DOCS / "tracks" / f"{name}.png").is_file()


def test_every_constant_of_the_diagnosis_says_what_it_means():
    source = "# m\nABOVE = 1\nBESIDE, TOO = 2.0, (3, 4)  # s\nSILENT = 5\nTEXT = 'no number'\n"
    assert parse_constants(source) == [
        ("ABOVE", "1", "m"),
        ("BESIDE, TOO", "2.0, (3, 4)", "s"),
        ("SILENT", "5", ""),
    ]
    silent = [
        (module, constant.names)
        for module, _, constants in modules()
        for constant in constants
        if not constant.comment
    ]
    assert not silent, f"expected a unit, a meaning or a reason in a comment beside {silent}"


@pytest.mark.slow
def test_pages_of_environments_and_effects_are_generated():
    pages = site_pages()
    assert all(text.strip() for text in pages.values())
    assert {f"effects/{effect.name}.md" for effect in EFFECTS} <= pages.keys()
