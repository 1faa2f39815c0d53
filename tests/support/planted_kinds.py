"""A kind of file whose loader breaks the promise as its files say, for ``test_reliability_files.py``."""

import os
import pickle
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.reliability.strangers.kind import Kind
from benchmarks.reliability.strangers.noise import Rng


class PlantedError(ValueError):
    """What these loaders may raise."""


def _write(folder: Path) -> None:
    (folder / "a.txt").write_bytes(b"well")


def _mutate(rng: Rng, contents: list[bytes]) -> bytes:
    return b"ill"


def _check(found: Any) -> None:
    assert found == "sound", "found what is not sound"


def _refuse(path: Path) -> Any:
    raise PlantedError(f"{path}: found 'ill', expected 'well'")


def _swallow(path: Path) -> Any:
    try:
        return bytes(2**31)
    except MemoryError as error:
        raise PlantedError(f"{path}: cannot be read") from error


def _spin(path: Path) -> Any:
    while True:
        pass


def _raise(text: str) -> Any:
    raise PlantedError(text)


def _first_of_nothing(path: Path) -> Any:
    return {}["first"]


FAULTS: dict[str, Callable[[Path], Any]] = {
    "unpickles": lambda path: pickle.loads(b"cbuiltins\nlen\n.") and "sound",
    "runs": lambda path: exec("1 + 1") or "sound",
    "writes": lambda path: (path.parent.parent / "outside").write_text("x") and "sound",
    "removes": lambda path: path.unlink() or "sound",
    "connects": lambda path: socket.socket().close() or "sound",
    "starts": lambda path: os.system("true") or "sound",
    "raises": _first_of_nothing,
    "mumbles": lambda path: _raise("found 'ill'"),
    "shouts": lambda path: _raise(f"{path}: {'x' * 100_000}"),
    "paints": lambda path: _raise(f"{path}: \x1b[31mred"),
    "eats": lambda path: bytes(2**31) and "sound",
    "swallows": _swallow,
    "spins": _spin,
    "crashes": lambda path: os.abort(),
    "lies": lambda path: "unsound",
}


def _load(path: Path) -> Any:
    """Load what is well, break the promise as a fault's name says, refuse the rest."""
    content = path.read_text()
    return "sound" if content == "well" else FAULTS.get(content, _refuse)(path)


def _hostile(_: list[bytes]) -> list[bytes]:
    return [name.encode() for name in FAULTS]


KINDS = {"planted": Kind(".txt", _write, _load, PlantedError, _check, _mutate, _hostile)}
