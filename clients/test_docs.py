"""docs/clients.md: its examples are complete, and what is trained; its margins are those of the tests."""

import ast
import builtins
import importlib
import re
import symtable
from pathlib import Path

import pytest

from clients.measure import CLIENTS

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "docs" / "clients.md").read_text(encoding="utf-8")
EXAMPLES = dict(re.findall(r"`clients/(\w+)\.py`:\n\n```python\n(.*?)```", TEXT, re.DOTALL))
GIVEN = {"seed", "env_id"}  # by the text around the examples


def test_there_is_an_example_for_every_client() -> None:
    assert set(EXAMPLES) == {module.__name__.partition(".")[2] for module in CLIENTS.values()}


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_is_what_is_trained(name: str) -> None:
    source = (ROOT / "clients" / f"{name}.py").read_text(encoding="utf-8")
    lines = iter([line.partition("  # noqa")[0].strip() for line in source.splitlines()])
    shown = [line.strip() for line in EXAMPLES[name].splitlines() if line]
    imports = [line for line in shown if line.startswith(("import ", "from "))]
    assert all(line in source for line in imports)
    for line in shown[len(imports) :]:
        assert line in lines, f"{name}: {line!r} is not, or not in this order, a line of clients/{name}.py"


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_is_complete(name: str) -> None:
    names = [node for node in ast.walk(ast.parse(EXAMPLES[name])) if isinstance(node, ast.Name)]
    used = {node.id for node in names if isinstance(node.ctx, ast.Load)}
    table = symtable.symtable(EXAMPLES[name], name, "exec")
    bound = {one.get_name() for one in table.get_symbols() if one.is_assigned() or one.is_imported()}
    inner = {one for child in table.get_children() for one in child.get_identifiers()}
    assert used - bound - inner - set(dir(builtins)) <= GIVEN


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_margins_are_those_of_the_tests(name: str) -> None:
    module = importlib.import_module(f"clients.{name}")
    section = TEXT.partition(EXAMPLES[name])[2].partition("\n## ")[0]
    margins = re.search(r"gains\s+([\d.]+)\s+and\s+an?\s+\w+\s+([\d.]+)\s+gates", section)
    assert margins is not None, section
    assert (float(margins[1]), float(margins[2])) == (module.RETURN_MARGIN, module.GATE_MARGIN)
