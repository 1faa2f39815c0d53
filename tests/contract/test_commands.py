"""The commands that README and quick start name have these flags, and refuse bad values in one line."""

import contextlib
import io
import re
import runpy
import shlex
import sys
import warnings
from functools import cache

import pytest

from flytrack_sysid.cli import main as sysid_main
from tests.support.pages import ROOT, commands

PAGES = ("README.md", "docs/quick_start.md")
COMMANDS = sorted({line for page in PAGES for line in commands((ROOT / page).read_text(encoding="utf-8"))})


def run(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a module (-m), a script, or flytrack-sysid in this process, in the repository's folder."""
    monkeypatch.chdir(ROOT)
    program, *rest = arguments[1:] if arguments[0] == "-m" else arguments
    monkeypatch.setattr(sys, "argv", [program, *rest])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # runpy: the module is imported already
        if program == "flytrack-sysid":
            sysid_main()
        elif arguments[0] == "-m":
            runpy.run_module(program, run_name="__main__")
        else:
            runpy.run_path(str(ROOT / program), run_name="__main__")


@cache
def help_of(*arguments: str) -> str:
    """Return what a command prints when it is asked for help."""
    text = io.StringIO()
    with pytest.MonkeyPatch.context() as monkeypatch, contextlib.redirect_stdout(text):
        monkeypatch.setenv("COLUMNS", "200")
        with pytest.raises(SystemExit) as stopped:
            run([*arguments, "--help"], monkeypatch)
    assert stopped.value.code == 0
    return text.getvalue()


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_and_its_flags_exist(command: str) -> None:
    words = shlex.split(command)
    if words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    elif words[0] != "mlflow":
        words = words[1:] if words[0] == "python" else words
        text = help_of(*words[: 1 if words[0].endswith(".py") else 2])
        flags = [word for word in words if word.startswith("--")]
        assert all(re.search(rf"{flag}\b", text) for flag in flags), text


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("eval_agent.py --steps 5 --checkpoint missing", "missing"),
        ("demo.py --black-box missing.bin", "missing.bin"),
        ("demo.py --total-timesteps 10", "total_timesteps|total-timesteps"),
    ],
)
def test_a_bad_value_ends_a_command_before_any_work(command, message, tmp_path, monkeypatch, capsys) -> None:
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as stopped:
        run([*shlex.split(command), "--out", str(out)], monkeypatch)
    errors = capsys.readouterr().err
    assert stopped.value.code == 2 and re.search(message, errors) and "Traceback" not in errors
    assert not any(out.glob("*"))
