"""Untrusted values in error messages: short, printable, on one line."""

import difflib
import reprlib
from collections.abc import Iterable, Sequence

MAX_NAME_LENGTH = 60  # characters
MAX_TEXT_LENGTH = 300


def quote_name(name: object) -> str:
    """Return a name: as it is, or shortened and quoted."""
    text = str(name)
    return (
        text
        if text.isprintable() and len(text) <= MAX_NAME_LENGTH
        else ascii(text[:MAX_NAME_LENGTH])
    )


def quote_value(value: object) -> str:
    """Return a value as Python writes it, shortened."""
    try:
        return reprlib.repr(value)
    except ValueError:  # Python refuses to print integers of more than 4300 digits
        return "a number of thousands of digits"


def error_text(error: BaseException) -> str:
    """Return an exception's message on one line, shortened; it may quote the file's content."""
    text = " ".join(str(error).split())[:MAX_TEXT_LENGTH]
    return text if text.isprintable() else ascii(text)[1:-1]


def check_keywords(found: Iterable[str], expected: Sequence[str]) -> None:
    """Raise TypeError for a keyword that ``make`` does not have, with the one that may be meant.

    In Python's own words, by which TorchRL finds out what an environment takes.
    """
    for name in found:
        if name not in expected:
            close = difflib.get_close_matches(name, expected, n=1)
            hint = (
                f"did you mean {close[0]!r}?" if close else f"expected one of {', '.join(expected)}"
            )
            raise TypeError(
                f"make() got an unexpected keyword argument {quote_name(name)!r}; {hint}"
            )
