"""What a run does beside training, and when; kept in its folder for when it is taken up again."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from baselines.purejaxrl_ppo.journal import SQLITE
from flytrack_env.files import write_atomically

OPTIONS = "options.json"
INTERVALS = ("checkpoint_every", "evaluate_every", "evaluation_episodes")


class Options(NamedTuple):
    """What a run does beside training; none of it changes the result.

    checkpoint_every, evaluate_every: environment steps; None: only the final checkpoint, no evaluation.
    evaluation_episodes: noisy starts of an evaluation. tracking_uri: MLflow store; None: no tracking.
    resume: checkpoint, or folder of checkpoints, to go on from. parent: folder of the sweep that this is a
    trial of, tracked before. report: called with steps and metrics after every evaluation.
    """

    checkpoint_every: int | None = None
    evaluate_every: int | None = None
    evaluation_episodes: int = 64
    tracking_uri: str | None = None
    resume: Path | None = None
    parent: Path | None = None
    report: Callable[[int, dict[str, float]], None] | None = None

    def check(self) -> None:
        """Raise ValueError, naming the option, for numbers that are not positive."""
        for name in INTERVALS:
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


def write_options(folder: Path, options: Options) -> None:
    """Write what a run does beside training into its folder, as OPTIONS."""
    write_atomically(folder / OPTIONS, options_as_bytes(folder, options))


def options_as_bytes(folder: Path, options: Options) -> bytes:
    """Return what OPTIONS holds in a run's folder.

    A store in a file is written by its path and by the way to it from the folder, so that it is found again
    when both were moved.
    """
    values = {name: getattr(options, name) for name in INTERVALS}
    uri = options.tracking_uri
    if uri is not None and uri.startswith(SQLITE):
        path = Path(uri.removeprefix(SQLITE)).resolve()
        uri = f"{SQLITE}{path}"
        values["store_from_here"] = os.path.relpath(path, folder.resolve())
    values["tracking_uri"] = uri
    return (json.dumps(values, indent=2) + "\n").encode()


def read_options(folder: Path) -> Options | None:
    """Return what ``write_options`` wrote; None where there is nothing.

    Raises:
        ValueError: a file that cannot be read, or values that cannot be used.
    """
    path = folder / OPTIONS
    if not path.exists():
        return None
    try:
        values = json.loads(path.read_bytes())
        options = Options(**{name: values[name] for name in (*INTERVALS, "tracking_uri")})
        options.check()
        store = values.get("store_from_here")
        if store is not None and (folder / store).exists():
            options = options._replace(tracking_uri=f"{SQLITE}{(folder / store).resolve()}")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path}: damaged: {error!r}; remove it to go on with the defaults") from error
    return options
