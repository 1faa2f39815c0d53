"""Pages are whole and self-contained, and show text from files without executing it."""

import re
from html import escape

from flytrack_sysid.page import Bullets, Picture, Section, Table, Text, Verdict, page

PNG = b"\x89PNG\r\n\x1a\n and the rest"
HOSTILE = '"><script>alert(1)</script><a href="https://example.org/x">'


def full_page(words):
    """Return a page with these words in every place that takes text."""
    parts = [
        Text(words),
        Verdict(words, "good"),
        Bullets([words]),
        Table([words, "b"], [[words, "2"]], caption=words),
        Table([words, "b"], [[words, "2"]], caption=words, is_text=True),
        Picture(PNG, words),
    ]
    return page(words, [Section(words, parts)], introduction=[Text(words)])


def test_hostile_text_is_only_shown_and_nothing_is_loaded_from_elsewhere():
    hostile, plain = full_page(HOSTILE), full_page("plain")
    assert hostile.replace(escape(HOSTILE), "plain") == plain
    for name in set(re.findall(r"<(\w+)", plain)) - {"meta", "img"}:
        assert len(re.findall(rf"<{name}\b", plain)) == plain.count(f"</{name}>"), name
    (target,) = re.findall(r'(?:src|href)="([^"]*)"', plain)
    assert target.startswith("data:image/png;base64,")
    assert not re.search(r"https?://|url\(|@import|<link|<script", plain)
