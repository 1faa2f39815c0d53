"""Commands that run, or end with one sentence about what cannot be used."""

from typing import Any

import pytest

from flytrack.cli import main


def run(*words: Any) -> None:
    """Run a command."""
    main([*map(str, words)])


def refused(capsys: pytest.CaptureFixture[str], *words: Any) -> str:
    """Run a command that must be refused and return its message, one line."""
    capsys.readouterr()
    with pytest.raises(SystemExit, match="2"):
        run(*words)
    message = capsys.readouterr().err
    assert message.startswith(f"flytrack {words[0]}: error: ") and message.count("\n") == 1, message
    return message
