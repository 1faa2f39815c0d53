"""The packages' annotations: mypy finds nothing in them, and who imports flytrack_env gets its types."""

import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGES = [name.rstrip("*") for name in PROJECT["tool"]["setuptools"]["packages"]["find"]["include"]]

CONSUMER = """
import flytrack_env

gates: int = flytrack_env.load_track("flytrack").gates
"""


def test_the_marker_of_types_is_shipped():
    """Without it a type checker takes everything that an installed package gives for Any."""
    shipped = PROJECT["tool"]["setuptools"]["package-data"]
    for package in PACKAGES:
        assert "py.typed" in shipped[package]
        assert (ROOT / package / "py.typed").is_file()


def test_every_package_of_the_wheel_is_checked():
    assert set(PACKAGES) <= set(PROJECT["tool"]["mypy"]["packages"])


@pytest.mark.slow
def test_mypy_is_content_and_tells_a_consumer_of_wrong_types(tmp_path, monkeypatch):
    """As ``make lint`` runs it; half a minute without a cache, most of it JAX."""
    api = pytest.importorskip("mypy.api")
    monkeypatch.chdir(ROOT)
    cache = ["--cache-dir", str(tmp_path / "cache")]
    report, trouble, status = api.run(cache)
    assert (status, trouble) == (0, ""), report + trouble
    (tmp_path / "consumer.py").write_text(CONSUMER)
    report, _, status = api.run([*cache, str(tmp_path / "consumer.py")])
    assert status == 1 and "consumer.py:4: error: Incompatible types in assignment" in report, report
