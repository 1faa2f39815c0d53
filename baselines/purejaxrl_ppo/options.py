"""What a run does beside training, and when."""

from pathlib import Path
from typing import NamedTuple


class Options(NamedTuple):
    """What a run does beside training; none of it changes the result.

    checkpoint_every, evaluate_every: environment steps; None: only the final checkpoint, no evaluation.
    evaluation_episodes: noisy starts of an evaluation. tracking_uri: MLflow store; None: no tracking.
    resume: checkpoint, or folder of checkpoints, to go on from.
    """

    checkpoint_every: int | None = None
    evaluate_every: int | None = None
    evaluation_episodes: int = 64
    tracking_uri: str | None = None
    resume: Path | None = None

    def check(self) -> None:
        """Raise ValueError, naming the option, for numbers that are not positive."""
        for name in ("checkpoint_every", "evaluate_every", "evaluation_episodes"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name}: found {value}, expected at least 1")


def next_due(update: int, every: int | None, batch_size: int) -> float:
    """Return the first update, after one, that reaches another multiple of ``every`` environment steps."""
    if every is None:
        return float("inf")
    reached = update * batch_size // every
    return -(-(reached + 1) * every // batch_size)


def is_due(update: int, every: int | None, batch_size: int) -> bool:
    """Return whether an update reaches another multiple of ``every`` environment steps."""
    return next_due(update - 1, every, batch_size) == update
