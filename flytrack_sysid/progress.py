"""A progress bar as a callback of ``collect``, ``fit`` and ``diagnose``."""

from tqdm import tqdm


class ProgressBar:
    """A bar that is called with the amounts done and in all; shown on terminals only."""

    def __init__(self, unit: str):
        self.bar = tqdm(unit=f" {unit}", leave=False, disable=None)

    def __call__(self, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` is done; the last one closes the bar."""
        self.bar.total = total
        self.bar.update(done - self.bar.n)
        if done == total:
            self.bar.close()
