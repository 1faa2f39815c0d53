"""Progress on a terminal, and lines where there is none."""

import gc
import io
import time

import pytest

from flytrack_env import progress
from flytrack_env.progress import LineBar, ProgressBar, TerminalBar, progress_bar, waiting


@pytest.fixture
def quick(monkeypatch):
    """Lines come after 0.05 s, and then every 0.1 s."""
    monkeypatch.setattr(progress, "FIRST_LINE_S", 0.05)
    monkeypatch.setattr(progress, "LINE_EVERY_S", 0.1)


def test_lines_come_while_the_work_says_nothing(quick, capsys):
    with waiting("read 2 files"):
        time.sleep(0.5)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) >= 3 and set(lines) == {"read 2 files: 00:00 so far"}


def test_a_bar_that_is_dropped_writes_no_more(quick, capsys):
    bar = LineBar("steps", 100)
    del bar
    gc.collect()
    time.sleep(0.3)
    assert capsys.readouterr().err == ""


def test_a_bar_that_is_disabled_writes_nothing(quick, capsys):
    bar = progress_bar("steps", 100, disable=True)
    bar.update(50)
    time.sleep(0.15)
    bar.close()
    assert capsys.readouterr().err == ""


def test_the_time_left_is_told_once_it_is_known_and_the_clock_does_not_jump(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    bar = LineBar("steps", 20_000_000, desc="compile", unit_scale=True)
    now[0] = 20.0
    assert bar.line() == "compile: 0.00 of 20.0M steps, 00:20 so far"
    bar.set_description("train")
    now[0] = 30.0
    bar.update(5_000_000)
    bar.set_postfix_str("return 1.0")
    assert bar.line() == "train: 5.00M of 20.0M steps, 00:30 so far, 00:30 left, return 1.0"
    bar.close()
    few = LineBar("stages", 5)
    few.update(2)
    assert "left" not in few.line()
    few.close()


def test_a_callback_closes_its_bar_with_a_last_line(quick, capsys):
    report = ProgressBar("flights")
    assert report.bar.line() == "0 flights, 00:00 so far"  # nobody knows yet of how many
    report(1, 48)
    time.sleep(0.2)
    report(48, 48)
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("48 of 48 flights, 00:00 so far")
    time.sleep(0.2)
    assert capsys.readouterr().err == ""


def open_terminal(monkeypatch):
    """Return the stream of a terminal on which bars are drawn every 0.05 s.

    Not a fixture: pytest sets stderr anew between set-up and call.
    """
    monkeypatch.setattr(progress, "REDRAW_EVERY_S", 0.05)
    stream = io.StringIO()
    stream.isatty = lambda: True
    monkeypatch.setattr("sys.stderr", stream)
    return stream


def test_a_bar_is_drawn_while_the_work_says_nothing_and_guesses_no_end(monkeypatch):
    terminal = open_terminal(monkeypatch)
    report = ProgressBar("stages")
    assert isinstance(report.bar, TerminalBar)
    report(1, 5)
    drawn = terminal.getvalue()
    time.sleep(0.5)
    silent = terminal.getvalue()[len(drawn) :].split("\r")
    assert len(silent) >= 3 and all("1 of 5 stages" in text for text in silent[-2:])
    assert "left" not in silent[-1] and "<" not in silent[-1]
    report(5, 5)
    closed = terminal.getvalue()
    time.sleep(0.2)
    assert terminal.getvalue() == closed
