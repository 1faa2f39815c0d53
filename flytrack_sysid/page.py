"""One self-contained HTML page of text, tables and pictures; nothing is loaded from elsewhere."""

import base64
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import NamedTuple

from flytrack_env.files import write_atomically

_STYLE = "\n" + Path(__file__).with_name("page.css").read_text(encoding="utf-8")
_PAGE = Template(Path(__file__).with_suffix(".html").read_text(encoding="utf-8"))


class Text(NamedTuple):
    """A paragraph."""

    text: str


class Bullets(NamedTuple):
    """A list of remarks."""

    items: Sequence[str]


class Verdict(NamedTuple):
    """The main result of a page.

    Attributes:
        text: the result in a sentence or two.
        tone: "good", "found" or "open", which determines its colour.
    """

    text: str
    tone: str


class Table(NamedTuple):
    """A table.

    Attributes:
        header: a cell per column.
        rows: cells, as many as the header has; the first is the name of the row.
        caption: text above the table.
        is_text: whether cells are text, which may wrap and have several lines, and not numbers.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    is_text: bool = False


class Picture(NamedTuple):
    """A PNG picture and its caption."""

    png: bytes
    caption: str


Part = Text | Verdict | Bullets | Table | Picture


class Section(NamedTuple):
    """A heading and the parts under it."""

    heading: str
    parts: Sequence[Part]


def _html_of_table(table: Table) -> str:
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in table.header)
    rows = ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in table.rows]
    body = "\n".join(f"<tr>{row}</tr>" for row in rows)
    caption = f"<caption>{escape(table.caption)}</caption>" if table.caption else ""
    kind = ' class="wrap"' if table.is_text else ""
    return (
        f'<div class="scroll"><table{kind}>{caption}\n<thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>"
    )


def _html_of(part: Part) -> str:
    if isinstance(part, Text):
        return f"<p>{escape(part.text)}</p>"
    if isinstance(part, Verdict):
        return f'<p class="verdict {part.tone}">{escape(part.text)}</p>'
    if isinstance(part, Bullets):
        return "<ul>\n" + "\n".join(f"<li>{escape(item)}</li>" for item in part.items) + "\n</ul>"
    if isinstance(part, Table):
        return _html_of_table(part)
    data, caption = base64.b64encode(part.png).decode("ascii"), escape(part.caption)
    return (
        f'<figure><img alt="{caption}" src="data:image/png;base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def page(title: str, sections: Sequence[Section], introduction: Sequence[Part] = ()) -> str:
    """Return an HTML document; all text is escaped, because it may come from files."""
    body = [f"<h1>{escape(title)}</h1>", *(_html_of(part) for part in introduction)]
    for section in sections:
        parts = "\n".join(_html_of(part) for part in section.parts)
        body.append(f"<section>\n<h2>{escape(section.heading)}</h2>\n{parts}\n</section>")
    content = "\n".join(body)
    return _PAGE.substitute(title=escape(title), style=_STYLE, content=content)


def text_table(
    rows: Sequence[Sequence[str]], justify: Callable[[str, int], str] = str.ljust
) -> list[str]:
    """Return rows of cells as lines of text with aligned columns.

    Args:
        rows: of cells, the header first.
        justify: pads the cells of all columns but the first.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join([first.ljust(widths[0]), *map(justify, others, widths[1:])]).rstrip()
        for first, *others in rows
    ]


def write_report(folder: str | Path, files: Mapping[str, bytes]) -> list[Path]:
    """Write the files of a report into a folder; return their paths."""
    paths = [Path(folder) / name for name in files]
    for path, content in zip(paths, files.values(), strict=True):
        write_atomically(path, content)
    return paths
