"""Commands that run, or end with one sentence about what cannot be used."""

import pytest

from flytrack.cli import main


def run(*words):
    """Run a command."""
    main([*map(str, words)])


def refused(capsys, *words):
    """Run a command that must be refused and return its message, one line."""
    capsys.readouterr()
    with pytest.raises(SystemExit, match="2"):
        run(*words)
    message = capsys.readouterr().err
    assert message.startswith(f"flytrack {words[0]}: error: ") and message.count("\n") == 1, message
    return message
