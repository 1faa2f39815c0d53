"""Markdown from templates, ``docs/templates``, and from docstrings."""

import re
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "templates"),
    undefined=StrictUndefined,
    keep_trailing_newline=True,
)
TEMPLATES.filters["g"] = lambda value: f"{value:g}"


def render(template: str, **values: Any) -> str:
    """Return a template's Markdown; its filter ``g`` writes numbers as Python's format "g" does."""
    return TEMPLATES.get_template(f"{template}.md.jinja").render(values)


def one_line(docstring: str | None) -> str:
    """Return a docstring as one line of Markdown."""
    text = re.sub(r"\s+", " ", docstring or "").strip()
    return text.replace("``", "`").replace("_*", r"_\*")  # v_* is no emphasis


def sentence(docstring: str | None) -> str:
    """Return a docstring's first paragraph without its "Return" and its full stop."""
    first = one_line((docstring or "").split("\n\n")[0]).removeprefix("Return ")
    return first.removeprefix("whether ").rstrip(".")


def field_texts(record: Any) -> dict[str, str]:
    """Return what a class's docstring says of its fields.

    The list of attributes describes them as "name: text." or "name, name: text.".
    """
    body = one_line(record.__doc__.rpartition("Attributes:")[2]).strip()
    parts = re.split(r"(?:^|(?<=[.;] ))((?:[a-z_*/]+(?:, )?)+): ", body)
    return {
        name: text.strip().rstrip(".;") for name, text in zip(parts[1::2], parts[2::2], strict=True)
    }
