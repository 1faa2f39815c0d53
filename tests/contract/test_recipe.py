"""What others install by says what the package says."""

import json
import re
import tomllib

import yaml

from flytrack_env import __version__
from tests.support.pages import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
CONDA_NAMES = {"flatbuffers": "python-flatbuffers"}  # where conda-forge has another one


def test_the_conda_recipe_has_the_dependencies_of_the_package():
    recipe = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text(encoding="utf-8"))
    assert recipe["context"]["version"] == __version__
    expected = {f"python {PROJECT['requires-python']}"}
    for requirement in PROJECT["dependencies"]:
        name, bounds = re.fullmatch(r"([\w-]+)(.*)", requirement).groups()
        expected.add(f"{CONDA_NAMES.get(name, name)} {bounds}")
    assert set(recipe["requirements"]["run"]) == expected
    assert recipe["about"]["license"] == PROJECT["license"]
    assert recipe["about"]["summary"] == PROJECT["description"]
    scripts = [f"{name} = {target}" for name, target in PROJECT["scripts"].items()]
    assert recipe["build"]["python"]["entry_points"] == scripts


def test_the_forms_of_issues_can_be_read():
    forms = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
    assert len(forms) == 3
    for path in forms:
        form = yaml.safe_load(path.read_text(encoding="utf-8"))
        assert form["name"] and form["description"]
        ids = [field["id"] for field in form["body"]]
        assert len(set(ids)) == len(ids)


def test_the_first_code_of_the_notebook_installs_what_is_missing():
    path = ROOT / "docs" / "notebooks" / "quick_start.ipynb"
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    first = "".join(next(cell["source"] for cell in cells if cell["cell_type"] == "code"))
    assert 'find_spec("flytrack") is None' in first and '"pip", "install"' in first


def test_addresses_are_the_placeholder_everywhere():
    texts = [PROJECT["urls"]["Repository"]]
    for name in ("README.md", "conda/recipe.yaml", "docs/notebooks/quick_start.ipynb"):
        texts.append((ROOT / name).read_text(encoding="utf-8"))
    assert all("github.com/OWNER/flytrack" in text for text in texts)
