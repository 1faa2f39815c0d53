"""The folder of a run: the checkpoints and seeds in it, and whether a training may write into it."""

import math
import re
from pathlib import Path

from baselines.purejaxrl_ppo.journal import Journal
from baselines.purejaxrl_ppo.options import OPTIONS

FINAL = "final.msgpack"
SEED_FOLDER = re.compile(r"seed(\d+)")
STEP_FILE = re.compile(r"step_(\d+)\.msgpack")
HALF_WRITTEN = re.compile(r"\.(step_\d+|final)\.msgpack\.[0-9a-f]{16}")  # as write_atomically names them


def steps_of(path: Path) -> float:
    """Return the steps in a checkpoint's name; infinity for one without, as the final one."""
    match = STEP_FILE.fullmatch(path.name)
    return int(match[1]) if match else math.inf


def checkpoints_in(folder: Path) -> list[Path]:
    """Return the checkpoints in a folder, newest first: by the steps in their names, the final one first."""
    steps = [path for path in folder.glob("*.msgpack") if STEP_FILE.fullmatch(path.name)]
    return [path for path in (folder / FINAL,) if path.exists()] + sorted(steps, key=steps_of, reverse=True)


def remove_half_written(folder: Path) -> None:
    """Remove what a killed process was writing: no checkpoint, and in nobody's way but the disk's."""
    for path in folder.glob(".*.msgpack.*"):
        if HALF_WRITTEN.fullmatch(path.name):
            path.unlink(missing_ok=True)


def seeds_in(folder: Path) -> list[int]:
    """Return the seeds of which a folder holds runs, as seed<N>, begun or about to begin."""
    matches = [(path, SEED_FOLDER.fullmatch(path.name)) for path in folder.glob("seed*")]
    return sorted(
        int(match[1])
        for path, match in matches
        if match and (checkpoints_in(path) or (path / OPTIONS).exists())
    )


def folder_of(source: Path) -> Path:
    """Return the folder of what a run goes on from, a checkpoint or a folder of checkpoints."""
    return source if source.is_dir() else source.parent


def is_its_folder(folder: Path, source: Path | None) -> bool:
    """Return whether a checkpoint, or folder of checkpoints, to go on from is in a folder."""
    return source is not None and folder.resolve() == folder_of(source).resolve()


def begins(folder: Path, source: Path | None) -> bool:
    """Return whether a run begins: it goes on from nothing, or from its own folder, which has nothing yet."""
    if source is None:
        return True
    return source.is_dir() and is_its_folder(folder, source) and not checkpoints_in(folder)


def check_free(folder: Path, source: Path | None = None, root: Path | None = None) -> None:
    """Raise ValueError where a folder holds a run that a training would overwrite.

    source: the checkpoint, or the folder of checkpoints, that the training goes on from; its own folder is
    where it may. root: of the seeds of which this is one. A journal that no store has all of counts as a run.
    """
    if is_its_folder(folder, source):
        return
    if checkpoints_in(folder):
        raise ValueError(
            f"{folder} holds the checkpoints of a run; go on with it (--resume {root or folder}), give "
            "another folder (--out), or remove it"
        )
    journal = Journal(folder)
    if not journal.is_sent():
        raise ValueError(
            f"{journal.path} tells of a run, and no store has all of it; upload it (python -m "
            f"baselines.purejaxrl_ppo.tracking {folder} --tracking-uri URI), give another folder (--out), or "
            "remove it"
        )
