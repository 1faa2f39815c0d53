"""Tables of data that tests go through, each in a file."""

import tomllib
from pathlib import Path

FOLDER = Path(__file__).with_name("tables")


def table(name):
    """Return what a file of tables has."""
    return tomllib.loads((FOLDER / f"{name}.toml").read_text(encoding="utf-8"))
