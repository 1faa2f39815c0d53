"""Progress as a callback of ``collect``, ``fit`` and ``diagnose``: a bar, or lines off a terminal."""

import sys
import time

from tqdm import tqdm

LINE_EVERY_S = 10.0  # off a terminal: often enough to see life, seldom enough for a file


class ProgressBar:
    """A bar that is called with the amounts done and in all; lines on stderr off a terminal."""

    def __init__(self, unit: str):
        self.unit, self.started = unit, time.monotonic()
        self.last_line = self.started
        self.bar = tqdm(unit=f" {unit}", leave=False, disable=None)

    def __call__(self, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` is done; the last one closes the bar."""
        self.bar.total = total
        self.bar.update(done - self.bar.n)
        now = time.monotonic()
        if self.bar.disable and now - self.last_line >= LINE_EVERY_S:
            self.last_line, elapsed_s = now, now - self.started
            left_s = elapsed_s * (total - done) / max(done, 1)
            line = f"{done} of {total} {self.unit}, {elapsed_s:.0f} s, about {left_s:.0f} s left"
            print(line, file=sys.stderr, flush=True)
        if done == total:
            self.bar.close()
