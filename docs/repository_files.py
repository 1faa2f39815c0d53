"""MkDocs hook: files of the repository outside of ``docs/`` that a page links to become pages of the site.

Markdown is shown as it is, other text as code, all of it under ``repository/``. Links in both directions
are rewritten, so that pages keep the relative links that work where the repository is browsed. A link to a
folder becomes plain text. A file that is not there is left alone: ``--strict`` then refuses the link.
"""

import posixpath
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

FOLDER = "repository"
LINK = re.compile(r"(!?\[[^\]]*\])\(([^)#\s]+)(#[^)\s]*)?\)")
BLOCK = re.compile(r"(^`{3,}.*?^`{3,}$)", re.MULTILINE | re.DOTALL)
LANGUAGES = {".py": "python", ".toml": "toml", ".json": "json"}


def outside_code(text: str, change: Callable[[str], str]) -> str:
    """Return Markdown with a change made to every stretch of it that is not in a fenced block."""
    parts = BLOCK.split(text)  # every second part is a block
    return "".join(part if i % 2 else change(part) for i, part in enumerate(parts))


def links_of(text: str) -> list[str]:
    """Return the relative targets that Markdown links to, without their anchors."""
    found: list[str] = []

    def note(stretch: str) -> str:
        found.extend(target for _, target, _ in LINK.findall(stretch) if ":" not in target)
        return stretch

    outside_code(text, note)
    return found


def place(root: Path, page: str) -> str:
    """Return a page's path in the repository: that of what it shows."""
    if not page.startswith(f"{FOLDER}/"):
        return f"docs/{page}"
    inner = page.removeprefix(f"{FOLDER}/")
    return inner if (root / inner).is_file() else inner.removesuffix(".md")


def page_of(path: str) -> str:
    """Return the page of the site that shows a file of the repository, by their paths."""
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    return f"{FOLDER}/{path}" if path.endswith(".md") else f"{FOLDER}/{path}.md"


def resolved(path: str, target: str) -> str:
    """Return the path in the repository that a file there links to."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(path), target))


def linked_files(root: Path, pages: list[str]) -> dict[str, str]:
    """Return the files outside of ``docs/`` that pages lead to: their paths and what is shown of them."""
    waiting, found = list(pages), {}
    while waiting:
        path = waiting.pop()
        for target in links_of((root / path).read_text(encoding="utf-8")):
            linked = resolved(path, target)
            if linked in found or linked.startswith(("docs/", "..")) or not (root / linked).is_file():
                continue
            content = (root / linked).read_text(encoding="utf-8")
            if linked.endswith(".md"):
                waiting.append(linked)
            else:
                language = LANGUAGES.get(Path(linked).suffix, "text")
                content = f"# {linked}\n\n````{language}\n{content}\n````\n"
            found[linked] = content
    return found


def led(root: Path, page: str, markdown: str) -> str:
    """Return a page's Markdown with its links led to where the site has their targets."""
    path = place(root, page)

    def lead(match: re.Match[str]) -> str:
        text, target, anchor = match.group(1), match.group(2), match.group(3) or ""
        if ":" in target:
            return match.group(0)
        linked = resolved(path, target)
        if (root / linked).is_dir():
            return text[1:-1]
        goal = posixpath.relpath(page_of(linked), posixpath.dirname(page) or ".")
        return f"{text}({goal}{anchor})"

    return outside_code(markdown, lambda stretch: LINK.sub(lead, stretch))


def on_files(files: "Files", config: "MkDocsConfig") -> "Files":
    """Add the files that pages link to, and those that these link to."""
    from mkdocs.structure.files import File  # here, so that the rest is there without MkDocs

    pages = [f"docs/{file.src_uri}" for file in files.documentation_pages()]
    for path, content in linked_files(Path(config.docs_dir).parent, pages).items():
        files.append(File.generated(config, page_of(path), content=content))
    return files


def on_page_markdown(markdown: str, page: "Page", config: "MkDocsConfig", files: "Files") -> str:
    """Return a page's Markdown with its links led to where the site has their targets."""
    return led(Path(config.docs_dir).parent, page.file.src_uri, markdown)
