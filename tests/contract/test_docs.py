"""The examples in the docs run, in order, as one script per page."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
PAGES = (
    "environment.md",
    "wrappers.md",
    "effects.md",
    "gymnasium.md",
    "pictures.md",
    "identification.md",
    "real_logs.md",
    "diagnosis.md",
)


def examples(page: str) -> str:
    """Return the Python of a page, its line numbers kept."""
    text = (DOCS / page).read_text(encoding="utf-8")
    kept, is_code = [], False
    for line in text.splitlines():
        if line.startswith("```"):
            is_code = line == "```python"
            line = ""
        kept.append(line if is_code else "")
    return "\n".join(kept)


@pytest.mark.parametrize("page", PAGES)
def test_examples_run(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = examples(page)
    (tmp_path / "blackbox").symlink_to(DOCS.parent / "blackbox")
    monkeypatch.chdir(tmp_path)  # pages may write files
    assert re.search(r"\S", code), f"{page}: no example"
    exec(compile("import gymnax\n" + code, page, "exec"), {})
