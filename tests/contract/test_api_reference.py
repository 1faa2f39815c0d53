"""Every public name has a docstring with what a user needs, and its place in the reference."""

import ast
import dataclasses
import fnmatch
import importlib
import inspect
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from docs.api_pages import GROUPS, api_pages, documented_names, public_names

ROOT = Path(__file__).parents[2]
PACKAGES = ("flytrack_env", "flytrack_sysid", "flytrack_loop", "baselines")
MODULES = [module for group in GROUPS.values() for module in group.modules]
PAGES = api_pages()
# Recorded results belong to these files by a hash of their bytes (benchmarks/diagnosis.py). They say in
# groups ("along body x, y, z") what others say by field; all have docstrings and name what they raise.
FROZEN = (
    r"flytrack_env\.(dynamics|effects\.\w+|effects)",
    r"flytrack_sysid\.(log|record|split|parameters|diagnosis\..*)",
)
ABSTRACT = "NotImplementedError"
ARRAY = re.compile(r"\b(jax\.Array|np\.ndarray|ArrayLike)\b")
SHAPE = re.compile(r"\([^()]*\w,[^()]*\)|\b(scalars?|shape|bool)\b")


def own(name: str) -> tuple[str, Any]:
    """Return "module.name" and the object that it names, one entry of the reference."""
    module, _, last = name.rpartition(".")
    return name, getattr(importlib.import_module(module), last)


def code_of(found: Any) -> Any:
    """Return the function behind a method or property; None for anything else."""
    found = found.fget if isinstance(found, property) else getattr(found, "__func__", found)
    return found if inspect.isfunction(found) else None


def methods(name: str, found: Any) -> Iterator[tuple[str, Any, bool]]:
    """Yield a class's public methods and properties, and whether a base has them, too."""
    for key, value in vars(found).items():
        function = code_of(value)
        if function and not key.startswith("_") and function.__module__ == found.__module__:
            yield f"{name}.{key}", function, any(hasattr(base, key) for base in found.__mro__[1:])


ENTRIES = [own(name) for name in documented_names()]
CALLABLES = [
    *((name, found, False) for name, found in ENTRIES if inspect.isfunction(found)),
    *(entry for name, found in ENTRIES if inspect.isclass(found) for entry in methods(name, found)),
]
CLASSES = [(name, found) for name, found in ENTRIES if inspect.isclass(found)]


def is_frozen(found: Any) -> bool:
    """Return whether an object's file may not change."""
    return any(re.fullmatch(pattern, found.__module__) for pattern in FROZEN)


def syntax(function: Any) -> ast.FunctionDef:
    """Return a function's syntax tree."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    assert isinstance(tree, ast.FunctionDef)
    return tree


def raised_by(function: Any) -> set[str]:
    """Return the exceptions that a function's own code raises by name."""
    raises = [node.exc for node in ast.walk(syntax(function)) if isinstance(node, ast.Raise) and node.exc]
    names = [exception.func if isinstance(exception, ast.Call) else exception for exception in raises]
    return {name.id for name in names if isinstance(name, ast.Name) and name.id[0].isupper()} - {ABSTRACT}


def fields_of(found: Any) -> list[str]:
    """Return the public fields that a NamedTuple or dataclass declares itself."""
    if not dataclasses.is_dataclass(found) and not hasattr(found, "_fields"):
        return []
    tree = ast.parse(textwrap.dedent(inspect.getsource(found))).body[0]
    assert isinstance(tree, ast.ClassDef)
    targets = [node.target for node in tree.body if isinstance(node, ast.AnnAssign)]
    return [target.id for target in targets if isinstance(target, ast.Name) and target.id[0] != "_"]


def says_of(found: Any, field: str) -> bool:
    """Return whether a class says what a field is: in its docstring, or beside or below the field."""
    named = re.findall(r"[\w*]+", found.__doc__ or "")
    if any(fnmatch.fnmatch(field, word) for word in named if word.strip("*_")):
        return True
    source = inspect.getsource(found)
    return bool(re.search(rf'^ +{field}: .*(#|\n +("""|#))', source, re.MULTILINE))


@pytest.mark.parametrize("name", documented_names())
def test_a_name_is_in_the_reference_and_has_a_docstring(name: str) -> None:
    module, _, last = name.rpartition(".")
    _, found = own(name)
    text = PAGES[f"{documented_names()[name]}.md"]
    section = text.partition(f"\n## {module}\n")[2].partition("\n## ")[0]
    assert f"\n::: {name}\n" in section or f"[`{last}`](" in section
    if inspect.isfunction(found) or inspect.isclass(found):
        first = (found.__doc__ or "").strip().split("\n\n")[0]
        assert len(first) > 10 and first.rstrip()[-1] in ".:)", first


@pytest.mark.parametrize(("name", "function", "is_override"), CALLABLES, ids=[name for name, *_ in CALLABLES])
def test_a_docstring_says_what_is_raised_and_which_shapes(
    name: str, function: Any, is_override: bool
) -> None:
    said = function.__doc__ or ""
    assert len(said.strip()) > 8, "no docstring"
    assert all(exception in said for exception in raised_by(function)), raised_by(function)
    signature = ast.unparse(syntax(function).args) + ast.unparse(
        syntax(function).returns or ast.Constant(None)
    )
    if ARRAY.search(signature) and not is_override and not is_frozen(function):
        assert SHAPE.search(said), f"no shape: {said}"


@pytest.mark.parametrize(("name", "found"), CLASSES, ids=[name for name, _ in CLASSES])
def test_a_class_says_what_its_fields_are(name: str, found: Any) -> None:
    if not is_frozen(found):
        assert [field for field in fields_of(found) if not says_of(found, field)] == []


def test_every_public_package_is_in_the_reference() -> None:
    files = [path for package in PACKAGES for path in (ROOT / package).rglob("__init__.py")]
    packages = [".".join(path.relative_to(ROOT).parent.parts) for path in files]
    public = [name for name in packages if hasattr(importlib.import_module(name), "__all__")]
    assert set(public) <= set(MODULES)


def imports_of(path: Path) -> set[str]:
    """Return "module.name" of every name of ours that the Python of a page imports."""
    names = set()
    for block in re.findall(
        r"^```python\n(.*?)^```", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    ):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in PACKAGES:
                names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def test_what_pages_tell_to_import_is_in_the_reference() -> None:
    told = set().union(*map(imports_of, [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]))
    modules = {name for name in told if name in MODULES}
    assert len(told) > 40 and told - modules <= set(documented_names())


def test_a_public_name_without_a_place_would_be_found() -> None:
    assert "make" in public_names("flytrack_env") and "_module" not in public_names("flytrack_env.pictures")
    assert raised_by(own("flytrack_env.load_track")[1]) == {"TrackError"}
    assert not says_of(own("flytrack_env.effects.LinearDrag")[1], "d_x") and not SHAPE.search(
        "Return the value."
    )
