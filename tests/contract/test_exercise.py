"""docs/exercise.md: every name and every command of it is there."""

import contextlib
import importlib
import io
import re
import runpy
import shlex
import sys
import warnings
from pathlib import Path

import pytest

from flytrack_sysid.cli import main as sysid_main

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "exercise.md").read_text(encoding="utf-8")
SPANS = re.findall(r"`([^`]+)`", TEXT)
NAMES = sorted(
    {span for span in SPANS if re.fullmatch(r"(flytrack_env|flytrack_sysid|blackbox)(\.\w+)+", span)}
)
COMMANDS = sorted({span for span in SPANS if re.match(r"(python|flytrack-sysid|make) ", span)})
DELIVERABLES = (
    "acro_step.bin",
    "acro_step_runtime.py",
    "model.py",
    "viz_rerun.py",
    "drone_race_env.py",
    "train_ppo.py",
    "eval_agent.py",
    "rollout.npy",
    "rollout.rrd",
    "report.md",
)


def test_every_deliverable_has_a_row() -> None:
    rows = re.findall(r"^\| `([\w.]+)` \|", TEXT, re.MULTILINE)
    assert set(DELIVERABLES) <= set(rows)


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_there(name: str) -> None:
    module, _, last = name.rpartition(".")
    try:
        assert hasattr(importlib.import_module(module), last)
    except ModuleNotFoundError:
        pytest.fail(f"{module}: no such module")


def help_of(words: list[str], monkeypatch: pytest.MonkeyPatch) -> str:
    """Return what a command says when it is asked for help."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), pytest.raises(SystemExit) as ended, warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # runpy: the module is imported already
        if words[0] == "flytrack-sysid":
            monkeypatch.setattr(sys, "argv", [words[0], words[1], "--help"])
            sysid_main()
        elif words[1] == "-m":
            monkeypatch.setattr(sys, "argv", [words[2], "--help"])
            runpy.run_module(words[2], run_name="__main__")
        else:
            monkeypatch.setattr(sys, "argv", [words[1], "--help"])
            runpy.run_path(str(ROOT / words[1]), run_name="__main__")
    assert ended.value.code == 0
    return said.getvalue()


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_and_its_flags_are_there(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words = shlex.split(command)
    if words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
        return
    said = help_of(words, monkeypatch)
    assert all(word in said for word in words if word.startswith("--"))


def test_this_page_is_read() -> None:
    assert len(NAMES) > 10 and len(COMMANDS) > 6
