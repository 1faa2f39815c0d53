"""One self-contained HTML page of text, tables and pictures; nothing is loaded from elsewhere."""

import base64
from collections.abc import Sequence
from html import escape
from typing import NamedTuple

_STYLE = """
:root { --ink: #1b1f24; --soft: #59636e; --line: #d5dae0; --paper: #ffffff; --note: #f4f6f8; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e9ec; --soft: #a3adb8; --line: #3a424b; --paper: #14181c; --note: #1e242a; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 52rem; padding: 1rem; color: var(--ink); background: var(--paper);
  font: 1rem/1.5 system-ui, sans-serif; overflow-wrap: break-word; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: 0.5rem 0; }
h2 { font-size: 1.2rem; margin: 2rem 0 0.5rem; padding-top: 0.75rem; border-top: 1px solid var(--line); }
ul { background: var(--note); border-left: 3px solid var(--soft); margin: 1rem 0;
  padding: 0.5rem 1rem 0.5rem 2rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: 0.5rem 0; font-variant-numeric: tabular-nums; }
caption, figcaption { text-align: left; color: var(--soft); font-size: 0.9rem; padding: 0.25rem 0; }
th, td { text-align: right; padding: 0.3rem 0.75rem; border-bottom: 1px solid var(--line);
  white-space: nowrap; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
.wrap td, .wrap th { white-space: pre-line; text-align: left; vertical-align: top; }
.verdict { margin: 1rem 0; padding: 0.75rem 1rem; border-left: 6px solid var(--soft); border-radius: 4px;
  background: var(--note); font-size: 1.15rem; }
.good { border-color: #009E73; } .found { border-color: #0072B2; } .open { border-color: #D55E00; }
figure { margin: 1rem 0; }
img { width: 100%; height: auto; background: #ffffff; border-radius: 4px; }
"""


class Text(NamedTuple):
    """A paragraph."""

    text: str


class Bullets(NamedTuple):
    """A list of remarks."""

    items: Sequence[str]


class Verdict(NamedTuple):
    """What matters at a glance; tone: its colour, "good", "found" or "open"."""

    text: str
    tone: str


class Table(NamedTuple):
    """A table; every row has as many cells as the header, the first names the row.

    is_text: cells hold text rather than numbers, which may wrap and have several lines.
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
    """A heading and what stands under it."""

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
    return f"""<!doctype html>
<html lang="en">
<head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>{_STYLE}</style></head>
<body>
{content}
</body></html>
"""
