"""The command ``flytrack``: documented flags exist and have help; missing extras are named."""

import contextlib
import io
import re
import shlex
import subprocess
import sys
import time
from functools import cache
from importlib.util import find_spec

import pytest

from flytrack.cli import COMMANDS, SHELLS, main
from tests.support.pages import ROOT, commands
from tests.support.slow import slow_but

PAGES = (
    "README.md",
    *(
        f"docs/{name}.md"
        for name in ("quick_start", "algorithm", "exercise", "betaflight", "claims")
    ),
)
SCRIPTS = {"train_ppo.py": "train", "eval_agent.py": "eval"}  # what each is the command of
LINES = sorted(
    {line for page in PAGES for line in commands((ROOT / page).read_text(encoding="utf-8"))}
)
# A flag, what it takes, and its help: two spaces or a new line part them.
ENTRY = re.compile(
    r"^ *((?:-\w, )?--[a-z].*?)(?: {2,}|\n)(.*?)(?=^ *(?:-\w, )?--[a-z]|\Z)", re.M | re.S
)
WITHOUT = """
import sys
from importlib.machinery import PathFinder
find = PathFinder.find_spec
blocked = set(sys.argv.pop(1).split(","))
def find_unless_blocked(name, *more):
    return None if name.split(".")[0] in blocked else find(name, *more)
PathFinder.find_spec = find_unless_blocked
from flytrack.cli import main
try:
    main([sys.argv[1], "--help"])
except SystemExit as ended:
    assert not ended.code
main(sys.argv[1:])
"""


@cache
def help_of(*arguments):
    """Return what a command prints when it is asked for help, without the boxes."""
    text = io.StringIO()
    with pytest.MonkeyPatch.context() as monkeypatch, contextlib.redirect_stdout(text):
        monkeypatch.setenv("COLUMNS", "200")
        with contextlib.suppress(SystemExit):  # argparse and tyro exit with 0
            main([*arguments, "--help"])
    return re.sub(r"[│╭╮╰╯─]", "", text.getvalue())


@pytest.mark.parametrize("line", LINES)
def test_a_command_of_the_docs_and_its_flags_exist(line):
    words = shlex.split(line)
    if words[0] == "python" and words[1] in SCRIPTS:
        assert (ROOT / words[1]).is_file()
        words[:2] = ["flytrack", SCRIPTS[words[1]]]
    if words[0] == "make":
        assert re.search(
            rf"^{words[1]}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE
        )
    elif words[0] == "flytrack" and words[1] in COMMANDS:
        flags = [word for word in words if word.startswith("--")]
        text = help_of(words[1])
        assert all(re.search(rf"{flag}\b", text) for flag in flags), text
    elif words[:2] == ["python", "-m"]:
        assert find_spec(words[2]) is not None, line
    else:
        assert words[0] in ("mlflow", "rerun", "flytrack"), line


@pytest.mark.parametrize("name", [*COMMANDS, "", "firmware build"])
def test_every_flag_says_what_it_does(name):
    entries = ENTRY.findall(help_of(*name.split()))
    bare = [
        flag
        for flag, text in entries
        if not re.search(r"[a-z]{2}", re.sub(r"\([^()]*\)", "", text))
    ]
    assert not bare and "None" not in help_of(*name.split()), bare
    assert entries or name == "firmware" or "cannot be shown" in help_of(name)


@pytest.mark.parametrize(
    "name",
    slow_but(["collect"], [name for name, command in COMMANDS.items() if command.extra]),
)
def test_without_its_extra_a_command_helps_and_says_what_to_install(name, tmp_path):
    words = {
        "fit": "log --out o",
        "validate": "m l --out o",
        "plan": "d --out o",
        "collect": "--out o",
        "diagnose": "log --out o",
        "import": "f --format csv --out o",
        "adapt": "log --out o",
    }
    blocked = "tqdm,matplotlib,rerun,optax,distrax,onnx,safetensors,mlflow,pygame"
    line = [sys.executable, "-c", WITHOUT, blocked, name, *words.get(name, "").split()]
    env = {"PYTHONPATH": str(ROOT), "PATH": "", "HOME": str(tmp_path), "JAX_PLATFORMS": "cpu"}
    ended = subprocess.run(line, cwd=tmp_path, env=env, capture_output=True, text=True)
    command, is_absent = COMMANDS[name], "not in this version" in ended.stdout
    how = "not in this version" if is_absent else f"pip install 'flytrack[{command.extra}]'"
    assert command.summary in ended.stdout and how in ended.stdout
    assert "--seed INT" in ended.stdout or name not in ("collect", "demo")
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1 and not any(tmp_path.glob("o*"))
    assert ended.stderr.startswith(f"flytrack {name}: error: ") and how in ended.stderr


def test_the_list_of_commands_is_quick_and_the_version_that_of_the_package(capsys):
    started = time.perf_counter()
    code = (
        "import sys; from flytrack.cli import main\n"
        "try: main(['--help'])\nfinally: print([*sys.modules])"
    )
    shown = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True
    ).stdout
    assert time.perf_counter() - started < 5.0  # 0.1 s, on a machine that does nothing else
    assert all(
        f"\n    {name} " in shown and command.summary in shown for name, command in COMMANDS.items()
    )
    assert "'argparse'" in shown and not re.search(r"'(jax|numpy|tyro)'", shown)
    with pytest.raises(SystemExit, match="2"):
        main(["land"])
    refusal = capsys.readouterr().err
    assert all(name in refusal for name in ("land", *COMMANDS))


@pytest.mark.parametrize("shell", SHELLS)
def test_shells_complete_commands_and_flags(shell, capsys):
    main(["--print-completion", shell])
    script = capsys.readouterr().out
    assert all(word in script for word in (*COMMANDS, "--noise", "total-timesteps")), script[:2000]
    (spec,) = [line for line in script.splitlines() if line.startswith("COMPLETION_SPEC = ")]
    assert "\\n" not in spec
