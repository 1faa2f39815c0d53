"""The page of the constants of the diagnosis, read from its source and the comments beside it."""

import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from docs.markdown import one_line, render
from flytrack_sysid import diagnosis, inference

CONSTANT = re.compile(r"[A-Z]\w*( =|,|: )")
NUMBERS = re.compile(r"(np\.array|float)?[-+*/.,\d\s()\[\]e]+(\[:\w+\])?")
PACKAGES = (diagnosis, inference)


class Constant(NamedTuple):
    """Constants of one statement: their names, the source of their values, and what is said."""

    names: str
    values: str
    comment: str


def constants_of(source: str) -> list[Constant]:
    """Return the statements of a module that assign numbers to constants, with their comments.

    A comment is on the lines of the statement, or above the group of constants that it belongs to.
    """
    lines = source.splitlines()
    result = []
    for node in ast.parse(source).body:
        if not isinstance(node, ast.Assign) or not CONSTANT.match(lines[node.lineno - 1]):
            continue
        if not NUMBERS.fullmatch(ast.unparse(node.value)):
            continue
        beside = " ".join(
            line.partition("  # ")[2] for line in lines[node.lineno - 1 : node.end_lineno]
        )
        first = node.lineno - 2
        while CONSTANT.match(lines[first]):
            first -= 1
        above = []
        while lines[first].startswith("# "):
            above.insert(0, lines[first].removeprefix("# "))
            first -= 1
        names = ", ".join(map(ast.unparse, node.targets)).strip("()")
        values = one_line(ast.unparse(node.value)).strip("()")
        result.append(Constant(names, values, beside.strip() or " ".join(above)))
    return result


def modules() -> Iterator[tuple[str, str, list[Constant]]]:
    """Yield each module with constants: its name, the first line of its docstring, and these."""
    for package in PACKAGES:
        for path in sorted(Path(folder_of(package)).glob("*.py")):
            source = path.read_text(encoding="utf-8")
            constants = constants_of(source)
            if constants:
                about = (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]
                yield f"{package.__name__}.{path.stem}", one_line(about), constants


def folder_of(package: ModuleType) -> str:
    """Return the folder of a package."""
    return str(Path(inspect.getfile(package)).parent)


def thresholds_page() -> str:
    """Return the page."""
    return render("thresholds", modules=list(modules()))
