"""docs/clients.md: its examples run, are what is trained, and ask for the margins that the tests ask for."""

import importlib
import re
from pathlib import Path
from typing import Any

import pytest

from clients.measure import CLIENTS

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "docs" / "clients.md").read_text(encoding="utf-8")
EXAMPLES = dict(re.findall(r"`clients/(\w+)\.py`:\n\n```python\n(.*?)```", TEXT, re.DOTALL))
# What an example takes long for, and what it is run with here.
SHORTENED = {
    "rejax_ppo": {"2_000_000": "32_768", "500_000": "16_384"},
    "sb3_ppo": {"1_000_000": "16_384"},
    "evosax_es": {"range(200)": "range(2)"},
}


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
def test_an_example_runs(name: str) -> None:
    code = EXAMPLES[name]
    for long, short in SHORTENED[name].items():
        assert code.count(long) == 1
        code = code.replace(long, short)
    names: dict[str, Any] = {"seed": 0, "env_id": "FlyTrack-v0"}
    exec(compile(code, f"docs/clients.md, {name}", "exec"), names)
    result = {"rejax_ppo": "act", "sb3_ppo": "model", "evosax_es": "fitness"}[name]
    assert result in names


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_margins_are_those_of_the_tests(name: str) -> None:
    module = importlib.import_module(f"clients.{name}")
    section = TEXT.partition(EXAMPLES[name])[2].partition("\n## ")[0]
    margins = re.search(r"gains\s+([\d.]+)\s+and\s+an?\s+\w+\s+([\d.]+)\s+gates", section)
    assert margins is not None, section
    assert (float(margins[1]), float(margins[2])) == (module.RETURN_MARGIN, module.GATE_MARGIN)
