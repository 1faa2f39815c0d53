"""The site's pages that are not in ``docs/``, written by mkdocs-gen-files when the site is built.

They are the pages that the code determines (environment ids, effects, tracks), and Markdown from
outside of ``docs/``. Links in the repository's Markdown are relative paths, so that they work where
it is browsed; here they are rewritten to the pages of the site. A link to a source file that has no
page becomes plain text.
"""

import json
import posixpath
import re
from pathlib import Path

from docs.effect_pages import effect_page, effects_table
from docs.env_pages import env_page
from docs.page_pictures import draw_effect, draw_env
from docs.threshold_pages import thresholds_page
from docs.track_pages import track_page
from flytrack_env.effects import EFFECTS
from flytrack_env.pictures import drawing
from flytrack_env.registration import ENVIRONMENTS
from flytrack_env.tracks import available_tracks

ROOT = Path(__file__).parents[1]
COPIED = ("CHANGELOG.md", "CONTRIBUTING.md", "report.md", "blackbox/README.md")  # to repository/
LINK = re.compile(r"(!?\[[^\]]*\])\((?!\w+:)([^)#\s]+)(#[^)\s]*)?\)")
BLOCK = re.compile(r"(^`{3,}.*?^`{3,}$)", re.MULTILINE | re.DOTALL)
# Pages of the site for what is a source file in the repository.
PAGES_OF_SOURCES = {
    "README.md": "index.md",
    **{path: f"repository/{path}" for path in COPIED},
    **{f"flytrack_env/effects/{effect.name}.py": f"effects/{effect.name}.md" for effect in EFFECTS},
    **{f"flytrack_env/tracks/{name}.toml": f"tracks/{name}.md" for name in available_tracks()},
}


def pictures() -> dict[str, bytes]:
    """Return the PNGs of the pages that the code determines, by their path on the site."""
    figures = {f"envs/{env_id}.png": draw_env(env_id) for env_id in ENVIRONMENTS}
    figures |= {f"effects/{effect.name}.png": draw_effect(effect) for effect in EFFECTS}
    return {path: drawing.png_of(figure) for path, figure in figures.items()}


def notebook_page(name: str) -> str:
    """Return the Markdown of a notebook in ``docs/notebooks``, its code in blocks."""
    path = ROOT / "docs" / "notebooks" / f"{name}.ipynb"
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    texts = ["".join(cell["source"]) for cell in cells]
    blocks = [
        f"```python\n{text}\n```" if cell["cell_type"] == "code" else text
        for cell, text in zip(cells, texts, strict=True)
    ]
    return "\n\n".join([*blocks, f"This page as a [notebook]({path.name}).\n"])


def with_links(markdown: str, path: str, page: str) -> str:
    """Rewrite the links in the Markdown of a repository file for its place at ``page``."""

    def rewrite(match: re.Match[str]) -> str:
        text, target, anchor = match.group(1), match.group(2), match.group(3) or ""
        linked = posixpath.normpath(posixpath.join(posixpath.dirname(path), target))
        goal = (
            linked.removeprefix("docs/")
            if linked.startswith("docs/")
            else PAGES_OF_SOURCES.get(linked)
        )
        if goal is None and (ROOT / linked).exists():
            return text[1:-1]
        relative = posixpath.relpath(goal or linked, posixpath.dirname(page) or ".")
        return f"{text}({relative}{anchor})"

    parts = BLOCK.split(markdown)  # every second part is a block of code
    return "".join(part if i % 2 else LINK.sub(rewrite, part) for i, part in enumerate(parts))


def site_pages() -> dict[str, str]:
    """Return all pages that the site adds or changes, by their path on it."""
    sources = {str(path.relative_to(ROOT)): path for path in sorted((ROOT / "docs").rglob("*.md"))}
    sources |= {path: ROOT / path for path in ("README.md", *COPIED)}
    ids = "".join(f"- [{env_id}](envs/{env_id}.md)\n" for env_id in ENVIRONMENTS)
    appended = {
        "effects.md": effects_table(),
        "environment.md": f"\n## Every id in detail\n\n{ids}",
    }
    pages = {f"envs/{env_id}.md": env_page(env_id) for env_id in ENVIRONMENTS}
    pages |= {f"effects/{effect.name}.md": effect_page(effect) for effect in EFFECTS}
    pages["api/thresholds.md"] = thresholds_page()
    pages |= {f"tracks/{name}.md": track_page(name) for name in available_tracks()}
    for notebook in (ROOT / "docs" / "notebooks").glob("*.ipynb"):
        pages[f"notebooks/{notebook.stem}.md"] = notebook_page(notebook.stem)
    for path, file in sources.items():
        page = PAGES_OF_SOURCES.get(path, path.removeprefix("docs/"))
        text = with_links(file.read_text(encoding="utf-8"), path, page)
        pages[page] = text + appended.get(page, "")
    return pages


def write() -> None:
    """Hand the pages to MkDocs."""
    import mkdocs_gen_files  # of the documentation's tools

    for path, text in site_pages().items():
        with mkdocs_gen_files.open(path, "w") as file:
            file.write(text)
    for path, content in pictures().items():
        with mkdocs_gen_files.open(path, "wb") as picture:
            picture.write(content)


if __name__ == "<run_path>":  # as mkdocs-gen-files runs it
    write()
