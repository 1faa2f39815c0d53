"""Imports point downwards and form no circle."""

import ast
from graphlib import CycleError, TopologicalSorter

import pytest

from tests.support.pages import ROOT
from tests.support.tables import table

PACKAGE = "flytrack_env"

LAYERED = table("layers")
RANKS = {name: rank for rank, layer in enumerate(LAYERED["layers"]) for name in layer}
CONSUMERS, ONLY_IN = LAYERED["consumers"], LAYERED["only_in"]
WINDOWS = ("pygame", "flytrack_fly")  # of all consumers, only that package opens windows


def files_of(name):
    """Return the Python files of a package or script at the root of the repository."""
    path = ROOT / name
    return sorted(path.rglob("*.py")) if path.is_dir() else [*ROOT.glob(f"{name}.py")]


def imports_of(path):
    """Return every dotted name that a file imports, anywhere in it, with its line."""
    imports = []
    package = path.relative_to(ROOT).parent.parts
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            imports += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join([*above, *([node.module] if node.module else [])])
            imports += [(f"{base}.{alias.name}", node.lineno) for alias in node.names]
    return imports


MODULES = files_of(PACKAGE)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_arrow_points_up_or_to_a_consumer_or_a_foreign_viewer(path):
    module = path.relative_to(ROOT / PACKAGE).with_suffix("").parts[0]
    assert module in RANKS, f"{module}: not in tests/support/tables/layers.toml; give it a place"
    for name, line in imports_of(path):
        parts = name.split(".")
        where = f"{path.relative_to(ROOT)}, line {line}: {module} imports {name}"
        assert parts[0] not in CONSUMERS and parts[0] != "tests", where
        assert ONLY_IN.get(parts[0], module) == module, where
        if parts[0] != PACKAGE:
            continue
        target = parts[1] if len(parts) > 1 and parts[1] in RANKS else "__init__"
        is_within = target == module and path.parent != ROOT / PACKAGE
        assert is_within or RANKS[target] < RANKS[module], where


CONSUMER_FILES = [path for name in CONSUMERS for path in files_of(name)]


@pytest.mark.parametrize("path", CONSUMER_FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_consumers_use_public_names_of_the_package(path):
    for name, line in imports_of(path):
        parts = name.split(".")
        assert parts[0] != WINDOWS[0] or path.parts[len(ROOT.parts)] == WINDOWS[1], (path, line)
        is_private = any(part.startswith("_") and not part.endswith("__") for part in parts)
        assert not (parts[0] == PACKAGE and is_private), (path, line, name)


REPOSITORY = (PACKAGE, *CONSUMERS)


def import_graph():
    """Return the modules of the repository with those that each imports anywhere in it."""
    imports = {}
    for path in (path for name in REPOSITORY for path in files_of(name)):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        imports[module] = [name for name, _ in imports_of(path)]
    graph = {}
    for module, names in imports.items():
        targets = {name if name in imports else name.rpartition(".")[0] for name in names}
        graph[module] = (targets & imports.keys()) - {module}
    return graph


def test_no_modules_import_each_other_in_a_circle():
    try:
        TopologicalSorter(import_graph()).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(reversed(error.args[1])))


def test_inference_imports_neither_fit_nor_diagnosis():
    above = ("diagnosis", "fit", "estimate", "validate", "prediction_errors")
    for module, targets in import_graph().items():
        if module.startswith("flytrack_sysid.inference"):
            assert not {
                name
                for name in targets
                if name.removeprefix("flytrack_sysid.").split(".")[0] in above
            }, module


def test_the_black_boxs_plant_is_reached_only_through_its_artifact():
    for name in (*REPOSITORY, "docs", "noxfile"):
        for path in files_of(name):
            packages = {imported.split(".")[0] for imported, _ in imports_of(path)}
            if name == "blackbox":
                assert not any(package.startswith("flytrack") for package in packages), path
            else:
                assert "blackbox" not in packages, path


def test_this_test_sees_imports():
    seen = {name for path in MODULES for name, _ in imports_of(path)}
    assert "flytrack_env.dynamics.ModelParameters" in seen and "gymnax" in seen
    assert len(CONSUMER_FILES) > 0
