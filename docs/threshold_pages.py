"""The page of the numeric constants of the diagnosis: its source, and the comments in that."""

import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from docs.markdown import one_line, render
from flytrack_sysid import diagnosis, inference

CONSTANT = re.compile(r"[A-Z]\w*( =|,)")
# Numbers, also in NumPy's calls and beside names of other constants.
NUMBERS = re.compile(r"(?=.*\d)(np\.\w+|float|[A-Z_]+|[-+*/.,:\d\s()\[\]e])+")
PACKAGES = (diagnosis, inference)


class Constant(NamedTuple):
    """Constants of one statement: their names, the source of their values, and what is said."""

    names: str
    values: str
    comment: str


def parse_constants(source: str) -> list[Constant]:
    """Return the statements of a module that assign numbers to constants, with their comments.

    A comment is on the lines of the statement, or directly above it.
    """
    lines = source.splitlines()
    result = []
    for node in ast.parse(source).body:
        if not isinstance(node, ast.Assign) or not CONSTANT.match(lines[node.lineno - 1]):
            continue
        if not NUMBERS.fullmatch(ast.unparse(node.value)):
            continue
        beside = [line.partition("# ")[2] for line in lines[node.lineno - 1 : node.end_lineno]]
        above = []
        for line in reversed(lines[: node.lineno - 1]):
            if not line.startswith("# "):
                break
            above.insert(0, line.removeprefix("# "))
        comment = " ".join(filter(None, beside)) or " ".join(above)
        names, values = (shown(one) for one in (node.targets[0], node.value))
        result.append(Constant(names, values, comment))
    return result


def shown(node: ast.expr) -> str:
    """Return an expression's source, a tuple without its parentheses."""
    parts = node.elts if isinstance(node, ast.Tuple) else [node]
    return ", ".join(map(ast.unparse, parts))


def modules() -> Iterator[tuple[str, str, list[Constant]]]:
    """Yield each module with constants: its name, the first line of its docstring, and these."""
    for package in PACKAGES:
        for path in sorted(Path(inspect.getfile(package)).parent.glob("*.py")):
            source = path.read_text(encoding="utf-8")
            constants = parse_constants(source)
            if constants:
                about = (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]
                yield f"{package.__name__}.{path.stem}", one_line(about), constants


def thresholds_page() -> str:
    """Return the page."""
    return render("thresholds", modules=list(modules()))
