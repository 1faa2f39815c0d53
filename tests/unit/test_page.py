"""Pages are whole and self-contained, and show text from files without executing it."""

import re
from html.parser import HTMLParser

from flytrack_sysid.page import Bullets, Picture, Section, Table, Text, Verdict, page

PNG = b"\x89PNG\r\n\x1a\n and the rest"
HOSTILE = '"><script>alert(1)</script><a href="https://example.org/x">'
VOID = {"meta", "img", "br"}


class Reader(HTMLParser):
    """Reads a page; collects elements, attributes and text, and checks that every element is closed."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.text = ""

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        self.attributes += attrs
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def read(text: str) -> Reader:
    """Return what a browser would see of a page."""
    reader = Reader()
    reader.feed(text)
    reader.close()
    assert reader.open == []
    return reader


def full_page(words: str) -> str:
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
    seen, plain = read(full_page(HOSTILE)), read(full_page("plain"))
    assert seen.seen == plain.seen and not {"script", "a"} & set(seen.seen)
    assert seen.text.count(HOSTILE) == plain.text.count("plain")
    assert ("alt", HOSTILE) in seen.attributes
    targets = [value for name, value in plain.attributes if name in ("src", "href")]
    assert len(targets) == 1 and targets[0].startswith("data:image/png;base64,")
    assert not re.search(r"https?://|url\(|@import|<link|<script", full_page("plain"))
