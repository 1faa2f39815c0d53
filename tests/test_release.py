"""What is released: its version is one, its packages are as declared, and the wheel works (slow)."""

import shutil
import tomllib
from pathlib import Path

import pytest

from flytrack_env.extras import check_installed
from release import check_wheel
from release.environments import HOW_TO_GET_UV, ReleaseError, find_uv
from release.fast_tests import FAST_TESTS

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS = set(PROJECT["project"]["optional-dependencies"])


def test_every_extra_is_checked():
    assert set(check_wheel.USE_OF) == (EXTRAS - {"dev"}) | {check_wheel.CORE}


def test_the_fast_tests_exist():
    assert len(set(FAST_TESTS)) == len(FAST_TESTS) > 0
    assert [name for name in FAST_TESTS if not (ROOT / name).is_file()] == []


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


@pytest.mark.slow
def test_the_wheel_works_with_each_extra_alone_and_tests_run_from_the_source(capsys):
    """Minutes, most of them for installing; without what ``[bench]`` compiles."""
    if shutil.which("uv") is None:
        pytest.skip(HOW_TO_GET_UV)
    names = [name for name in check_wheel.USE_OF if name != "bench"]
    assert check_wheel.main(["--only", *names]) == 0, capsys.readouterr().err
