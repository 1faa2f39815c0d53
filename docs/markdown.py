"""Markdown that the generated pages are made of."""

import re
import textwrap
from typing import Any

GENERATED = "<!-- Written by `python -m docs.pages`; change the code or that script, not this page. -->"
WIDTH = 120


def sentence(text: str) -> str:
    """Return a docstring's first sentence without its "Return"."""
    first = re.sub(r"\s+", " ", text.split("\n\n")[0]).removeprefix("Return ").strip().rstrip(".")
    return first.removeprefix("whether ").replace("``", "`")


def paragraph(*texts: str) -> list[str]:
    """Return sentences as wrapped lines, and a blank line."""
    return [*textwrap.wrap(" ".join(texts), WIDTH, break_long_words=False, break_on_hyphens=False), ""]


def table(header: tuple[str, ...], rows: list[tuple[Any, ...]]) -> list[str]:
    """Return a Markdown table, and a blank line."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return [*lines, *("| " + " | ".join(str(cell) for cell in row) + " |" for row in rows), ""]


def field_texts(record: Any) -> dict[str, str]:
    """Return what a class's docstring says of its fields, each "name: text." or "name, name: text."."""
    body = re.sub(r"\s+", " ", record.__doc__.partition("\n\n")[2]).strip()
    parts = re.split(r"(?:^|(?<=[.;] ))((?:[a-z_*/]+(?:, )?)+): ", body)
    return {name: text.strip().rstrip(".;") for name, text in zip(parts[1::2], parts[2::2], strict=True)}


def words_of_docstring(record: Any) -> str:
    """Return a docstring as one line of Markdown."""
    text = re.sub(r"\s+", " ", record.__doc__ or "").strip()
    return text.replace("``", "`").replace("_*", r"_\*")  # v_* is no emphasis


def code(*lines: str, language: str = "python") -> list[str]:
    """Return a fenced block of code, and a blank line."""
    return [f"```{language}", *lines, "```", ""]


def page(*lines: str) -> str:
    """Return a generated page of these lines."""
    return "\n".join([GENERATED, "", *lines]).rstrip() + "\n"
