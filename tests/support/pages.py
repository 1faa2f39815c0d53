"""Markdown pages: their Python examples and their commands."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def examples(text):
    """Return the Python of a page."""
    return "\n".join(code for language, code in BLOCK.findall(text) if language == "python")


def run_examples(text, folder, monkeypatch):
    """Run a page's Python as one script in a folder and return its names."""
    (folder / "blackbox").symlink_to(ROOT / "blackbox")
    monkeypatch.chdir(folder)
    names = {}
    exec(compile("import gymnax\n" + examples(text), "page", "exec"), names)
    return names


def commands(text):
    """Return the commands in a page's shell blocks, one a line, without their comments."""
    lines = [
        line
        for language, code in BLOCK.findall(text)
        if language in ("", "bash")
        for line in code.splitlines()
    ]
    starts = (".venv/bin/", "make ", "python ", "flytrack ")
    return [
        line.partition("  #")[0].removeprefix(".venv/bin/")
        for line in lines
        if line.startswith(starts)
    ]
