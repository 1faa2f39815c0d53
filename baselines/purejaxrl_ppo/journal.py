"""The journal of a run: all that it tells, one JSON object a line, and what each store was told of it."""

import json
import logging
import os
import time
from pathlib import Path
from typing import Any

from flytrack_env.files import write_atomically

JOURNAL = "tracking.jsonl"
SENT = "tracking_sent.json"
SQLITE = "sqlite:///"
# What an entry of each kind holds beside its time.
FIELDS: dict[str, dict[str, type]] = {
    "run": {"experiment": str, "name": str, "params": dict},
    "metrics": {"step": int, "values": dict},
    "file": {"path": str, "group": str},
    "status": {"status": str},
}
UNREADABLE: dict[str, Any] = {"kind": "unreadable"}  # keeps the place of a line, which stores count
MOST_LINES = 10  # of those named in a warning

logger = logging.getLogger(__name__)


class JournalError(ValueError):
    """A journal that cannot be sent; the message names the file and what it lacks."""


class Journal:
    """The entries of one run, in a file that only grows; what the stores were told, in another.

    A line that cannot be read, as one that a kill or a full disk cut off, is skipped with a warning.
    Only ``append`` writes, so that the journal of a run under way can be read.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.path = folder / JOURNAL
        *lines, rest = (self.path.read_bytes() if self.path.exists() else b"").split(b"\n")
        self._is_cut_off = bool(rest)
        self.entries = [_read_entry(line) for line in lines]
        bad = [str(number) for number, entry in enumerate(self.entries, start=1) if entry is UNREADABLE]
        bad += [str(len(lines) + 1)] if rest else []
        if bad:
            more = f" and {len(bad) - MOST_LINES} more" if len(bad) > MOST_LINES else ""
            numbers = ", ".join(bad[:MOST_LINES]) + more
            logger.warning("%s: line %s: damaged or cut off, skipped", self.path, numbers)

    def append(self, kind: str, **values: Any) -> None:
        """Add an entry.

        Raises:
            OSError: what the system says; what is in the file of the entry is a damaged line.
        """
        entry = {"kind": kind, "time_ms": int(time.time() * 1000), **values}
        self.folder.mkdir(parents=True, exist_ok=True)
        before = [UNREADABLE] if self._is_cut_off else []
        self._is_cut_off = True
        with self.path.open("a", encoding="utf-8") as file:
            file.write("\n" * len(before) + json.dumps(entry) + "\n")
        self._is_cut_off = False
        self.entries += [*before, entry]

    def flush(self) -> None:
        """Return when all entries are on the disk, and not only with the system."""
        with self.path.open("ab") as file:
            os.fsync(file.fileno())

    def of_kind(self, kind: str) -> list[dict[str, Any]]:
        """Return the entries of a kind."""
        return [entry for entry in self.entries if entry["kind"] == kind]

    def beginning(self) -> dict[str, Any]:
        """Return the entry that says what the run is.

        Raises:
            JournalError: there is none.
        """
        found = self.of_kind("run")
        if not found:
            raise JournalError(
                f"{self.path}: found {len(self.entries)} lines and none that says what the run is, expected "
                "the journal of a tracked run"
            )
        return found[0]

    def sent(self, uri: str) -> tuple[str | None, int]:
        """Return the run's id in a store and how many entries it has; None and 0 before the first."""
        stores = self._stores()
        run_id, count = next((stores[key] for key in self._keys(uri) if key in stores), (None, 0))
        return run_id, count

    def mark_sent(self, uri: str, run_id: str, count: int) -> None:
        """Note that a store has a run with the first ``count`` entries."""
        stores = {**self._stores(), **{key: [run_id, count] for key in self._keys(uri)}}
        write_atomically(self.folder / SENT, (json.dumps(stores) + "\n").encode())

    def is_sent(self) -> bool:
        """Return whether there is a store that has all of it."""
        return max((count for _, count in self._stores().values()), default=0) >= len(self.entries)

    def _keys(self, uri: str) -> list[str]:
        """Return what a store is noted under: its address, and of a file where it is from the run's folder.

        By the second it is known again when the run was moved together with its store.
        """
        if not uri.startswith(SQLITE):
            return [uri]
        path = Path(uri.removeprefix(SQLITE)).resolve()
        return [uri, SQLITE + os.path.relpath(path, self.folder.resolve())]

    def _stores(self) -> dict[str, Any]:
        path = self.folder / SENT
        if not path.exists():
            return {}
        try:
            stores = json.loads(path.read_bytes())
            return {uri: (str(run_id), int(count)) for uri, (run_id, count) in stores.items()}
        except (ValueError, AttributeError, TypeError, RecursionError) as error:
            raise JournalError(f"{path}: damaged: {error}; remove it to send everything again") from error


def forget(folder: Path) -> None:
    """Remove a folder's journal and what the stores were told of it, for a run that begins there."""
    for name in (JOURNAL, SENT):
        (folder / name).unlink(missing_ok=True)


def _read_entry(line: bytes) -> dict[str, Any]:
    """Return the entry of a line."""
    try:
        entry = json.loads(line)
        fields = {"time_ms": int, **FIELDS[entry["kind"]]}
        is_whole = all(isinstance(entry[name], kind) for name, kind in fields.items())
    except (ValueError, TypeError, KeyError, RecursionError):
        return UNREADABLE
    return entry if is_whole else UNREADABLE
