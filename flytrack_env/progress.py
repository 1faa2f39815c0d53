"""Progress of long work: a bar on a terminal, a line every 10 s elsewhere.

tqdm comes with the extras.
"""

import sys
from typing import Any, TextIO

from tqdm import tqdm

LINE_EVERY_S = 10.0
LINE = "{desc}{n_fmt} of {total_fmt}{unit}, {elapsed} so far, {remaining} left{postfix}"


class Lines:
    """A stream that takes tqdm's bar, which is drawn over and over, and writes it as lines."""

    def __init__(self, stream: TextIO):
        self.stream = stream

    def write(self, text: str) -> None:
        """Write a line, unless there is nothing in it."""
        if text := text.strip():
            self.stream.write(f"{text}\n")

    def flush(self) -> None:
        """Pass on what was written."""
        self.stream.flush()


def progress_bar(unit: str, **options: Any) -> Any:
    """Return a bar of tqdm on stderr; ``options`` are tqdm's. Off a terminal it writes lines."""
    if not sys.stderr.isatty():
        options |= {"file": Lines(sys.stderr), "bar_format": LINE, "delay": LINE_EVERY_S}
        options |= {"mininterval": LINE_EVERY_S, "maxinterval": LINE_EVERY_S, "miniters": 1}
    return tqdm(unit=f" {unit}", **options)


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
