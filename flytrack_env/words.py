"""What a stranger's file says, as the message of an error can have it: short, and of printable characters."""

import reprlib

LONGEST_NAME = 60  # characters
LONGEST_TEXT = 300


def named(name: object) -> str:
    """Return a name: as it is, or shortened and quoted."""
    text = str(name)
    return text if text.isprintable() and len(text) <= LONGEST_NAME else ascii(text[:LONGEST_NAME])


def shown(value: object) -> str:
    """Return a value as Python writes it, shortened."""
    try:
        return reprlib.repr(value)
    except ValueError:  # Python writes no numbers of more than 4300 digits
        return "a number of thousands of digits"


def said(error: BaseException) -> str:
    """Return an exception's text in one line: what is in a file is often part of it."""
    text = " ".join(str(error).split())[:LONGEST_TEXT]
    return text if text.isprintable() else ascii(text)[1:-1]
