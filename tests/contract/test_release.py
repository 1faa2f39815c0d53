"""What is released: one version, a guide that names what there is, and a wheel that works (slow)."""

import importlib
import importlib.util
import re
import shutil
import tomllib
from pathlib import Path

import pytest
import yaml

import flytrack_env
from flytrack_env.extras import check_installed
from release import check_wheel
from release.environments import HOW_TO_GET_UV, ReleaseError, find_uv
from release.fast_tests import FAST_TESTS

ROOT = Path(__file__).parents[2]
GUIDE = (ROOT / "CONTRIBUTING.md").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS = set(PROJECT["project"]["optional-dependencies"])


def test_every_extra_is_checked():
    assert set(check_wheel.USE_OF) == (EXTRAS - {"dev", "docs"}) | {check_wheel.CORE}


def test_the_fast_tests_exist():
    assert len(set(FAST_TESTS)) == len(FAST_TESTS) > 0
    for name in FAST_TESTS:
        path, _, test = name.partition("::")
        assert f"def {test}" in (ROOT / path).read_text(), name


def test_what_is_missing_is_named_with_its_extra():
    check_installed("core", "tests", "jax", "pytest")
    with pytest.raises(ImportError, match=r"^flights need no_such_module, .*pip install 'flytrack\[viz\]'$"):
        check_installed("viz", "flights", "pytest", "no_such_module")


def test_without_uv_the_check_says_how_to_get_it(monkeypatch, capsys):
    monkeypatch.setattr(shutil, "which", lambda *arguments, **options: None)
    with pytest.raises(ReleaseError, match="pip install uv"):
        find_uv()
    assert check_wheel.main(["--only", "core"]) == 1
    assert HOW_TO_GET_UV in capsys.readouterr().err


def named(pattern: str) -> list[str]:
    """Return what a pattern finds between backticks in the guide for contributors; at least one."""
    found = [match for code in re.findall(r"`([^`\n]+)`", GUIDE) for match in re.findall(pattern, code)]
    assert found
    return found


def test_the_guide_names_files_that_exist():
    for path in named(r"^(?:\w+/)+[\w.]*$"):
        assert (ROOT / path).exists() or path == "dist/", path


def test_the_guide_names_what_can_be_imported():
    for name in named(r"^(flytrack_env\.[\w.]+)"):
        module, _, attribute = name.rpartition(".")
        assert hasattr(importlib.import_module(module), attribute), name
    for name in named(r"python -m (\w+(?:\.\w+)+)"):
        assert importlib.util.find_spec(name) is not None, name


def test_the_guide_names_targets_of_make_and_lists_of_tests():
    targets = re.findall(r"^([\w-]+)[\w -]*:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert set(named(r"^make ([\w-]+)")) <= {*targets, "check-versions", "check-wheel"}
    for name, path in (
        ("LAYERS", "tests/contract/test_layers.py"),
        ("ALL", "tests/unit/test_wrappers.py"),
        ("EFFECTS", "flytrack_env/effects/__init__.py"),
        ("EVIDENCE", "flytrack_sysid/diagnosis/evidence.py"),
        ("ENVIRONMENTS", "flytrack_env/registration.py"),
    ):
        assert name in named(r"^[A-Z]+$") and path in named(r"^[\w./]+\.py$")
        assert re.search(rf"^{name}\b.*=", (ROOT / path).read_text(), re.MULTILINE), f"{path}: no {name}"


def test_version_and_date_are_one():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    newest = re.search(r"^## \[(\d[^]]*)\] - (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest is not None
    assert newest[1] == citation["version"] == flytrack_env.__version__
    assert newest[2] == citation["date-released"]


def test_the_citation_is_of_this_package():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0" and citation["type"] == "software"
    assert citation["license"] == PROJECT["project"]["license"]
    assert [author["name"] for author in citation["authors"]] == [
        author["name"] for author in PROJECT["project"]["authors"]
    ]


@pytest.mark.slow
def test_the_wheel_works_with_each_extra_alone_and_tests_run_from_the_source(capsys):
    """Minutes, most of them for installing; without what ``[bench]`` compiles."""
    if shutil.which("uv") is None:
        pytest.skip(HOW_TO_GET_UV)
    names = [name for name in check_wheel.USE_OF if name != "bench"]
    assert check_wheel.main(["--only", *names]) == 0, capsys.readouterr().err
