"""Progress of long work: a bar on a terminal, lines elsewhere.

A line comes within 5 s, and then every 10 s, also where the work itself says nothing for minutes,
as in a compilation. A bar is redrawn every second. The time left is told once some of the work
that counts is done.

tqdm comes with the extras.
"""

import sys
import threading
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

FIRST_LINE_S, LINE_EVERY_S = 4.0, 10.0
REDRAW_EVERY_S = 1.0
MIN_STEPS = 10  # of a work whose time left is told: a few stages differ too much in length
FEW_STEPS_FORMAT = "{l_bar}{bar}| {n_fmt} of {total_fmt}{unit} [{elapsed} so far{postfix}]"


class LineBar:
    """What stands in for tqdm's bar where there is no terminal: it writes lines.

    Args:
        unit: what is counted.
        total: how much is to be done; None if nothing is counted.
        initial: how much was done before.
        desc: what is done.
        unit_scale: numbers are written with k and M.
        disable: nothing is written, but what ``write`` is given.
    """

    def __init__(
        self,
        unit: str,
        total: int | None = None,
        initial: int = 0,
        desc: str = "",
        unit_scale: bool = False,
        disable: bool = False,
    ):
        self.unit, self.total, self.n, self.desc = unit, total, initial, desc
        self._is_large, self._postfix = unit_scale, ""
        self._began_s = self._counted_from_s = time.monotonic()
        self._initial, self._written, self._is_closed = initial, "", threading.Event()
        if disable:
            self._is_closed.set()
        # A bar that is dropped without an end, as by an error, must not go on writing.
        beat = threading.Thread(
            target=_refresh_until_closed,
            args=(weakref.ref(self), self._is_closed, FIRST_LINE_S, LINE_EVERY_S),
            daemon=True,
        )
        beat.start()

    def update(self, count: int) -> None:
        """Count what was done."""
        self.n += count

    def set_description(self, desc: str) -> None:
        """Change what is done; what has passed is left out of the time left."""
        self.desc = desc
        self._counted_from_s = time.monotonic()

    def set_postfix_str(self, text: str, refresh: bool = True) -> None:
        """Change what stands behind the numbers."""
        self._postfix = text

    def write(self, text: str) -> None:
        """Write a text at once, to standard output."""
        print(text, flush=True)

    def line(self) -> str:
        """Return the line that is written."""
        now_s = time.monotonic()
        parts = [f"{tqdm.format_interval(now_s - self._began_s)} so far"]
        if self.unit and not self.total:
            parts.insert(0, f"{self.n} {self.unit}")
        elif self.total:
            count = tqdm.format_sizeof if self._is_large else str
            parts.insert(0, f"{count(self.n)} of {count(self.total)} {self.unit}")
            done, is_known = self.n - self._initial, self.total >= MIN_STEPS
            if done > 0 and is_known:
                each_s = (now_s - self._counted_from_s) / done
                left_s = each_s * (self.total - self.n)
                parts.append(f"{tqdm.format_interval(left_s)} left")
        text = ", ".join(filter(None, (*parts, self._postfix)))
        return f"{self.desc}: {text}" if self.desc else text

    def refresh(self) -> None:
        """Write the line."""
        self._written = self.line()
        print(self._written, file=sys.stderr, flush=True)

    def close(self) -> None:
        """End the lines; one more is written if any was."""
        if not self._is_closed.is_set() and self._written and self.total:
            self.refresh()
        self._is_closed.set()


def _refresh_until_closed(
    bar: "weakref.ref[Any]", is_closed: threading.Event, first_s: float, every_s: float
) -> None:
    """Refresh a bar after ``first_s``, then every ``every_s``, until it is closed or gone."""
    wait_s = first_s
    while not is_closed.wait(wait_s):
        alive = bar()
        if alive is None:
            return
        alive.refresh()
        wait_s = every_s
        del alive


class TerminalBar(tqdm):
    """tqdm's bar, whose clock also runs while the work itself says nothing.

    tqdm draws only when something is counted, so a stage of minutes looks like a program that
    hangs.
    """

    def __init__(self, *args: Any, **options: Any):
        self._is_closed = threading.Event()
        self._beat = threading.Thread(
            target=_refresh_until_closed,
            args=(weakref.ref(self), self._is_closed, REDRAW_EVERY_S, REDRAW_EVERY_S),
            daemon=True,
        )
        super().__init__(*args, **options)
        if not self.disable:
            self._beat.start()

    @property
    def format_dict(self) -> Any:
        """Return what the bar is drawn from, without a time left if the steps are few."""
        values = super().format_dict
        if values["total"] and values["total"] < MIN_STEPS:
            values["bar_format"] = FEW_STEPS_FORMAT
        return values

    def close(self) -> None:
        """End the bar; nothing draws it after that."""
        self._is_closed.set()
        if self._beat.is_alive() and self._beat is not threading.current_thread():
            self._beat.join()
        super().close()


def progress_bar(unit: str, total: int | None = None, **options: Any) -> Any:
    """Return a bar on stderr: tqdm's on a terminal, lines elsewhere.

    Args:
        unit: what is counted.
        total: how much is to be done.
        options: of tqdm: ``initial``, ``desc``, ``leave``, ``unit_scale`` and ``disable``.
    """
    if sys.stderr.isatty():
        return TerminalBar(unit=f" {unit}", total=total, **options)
    options.pop("leave", None)  # lines stay
    return LineBar(unit, total, **options)


@contextmanager
def waiting(what: str) -> Iterator[None]:
    """Say from time to time what is done, while nothing of it can be counted."""
    bar = LineBar("", desc=what)
    try:
        yield
    finally:
        bar.close()


class ProgressBar:
    """A callback of ``collect``, ``fit`` and ``diagnose`` that shows how much of all is done."""

    def __init__(self, unit: str):
        self.bar = progress_bar(unit, leave=False)

    def __call__(self, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` is done; the last one closes the bar."""
        self.bar.total = total
        self.bar.update(done - self.bar.n)
        if done == total:
            self.bar.close()

    def write(self, text: str) -> None:
        """Print text above the bar, at once."""
        self.bar.write(text)
        sys.stdout.flush()
