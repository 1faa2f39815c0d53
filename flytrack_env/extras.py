"""Packages that only an extra of FlyTrack brings, and objects in modules of the user's own."""

import importlib
import sys
from importlib.metadata import version
from importlib.util import find_spec
from operator import attrgetter
from pathlib import Path
from types import ModuleType
from typing import Any

PACKAGES = {
    "PIL": "Pillow",
    "pygame": "pygame-ce",
    "rerun": "rerun-sdk",
}  # where the module's name differs
OLDEST_GYMNAX = 1
DRAWS = "seaborn"  # imported by gymnax for its own pictures


def is_installed(module: str) -> bool:
    """Return whether a module is there to be imported; does not import it."""
    return find_spec(module) is not None


def check_gymnax(found: str) -> None:
    """Raise ImportError if this version of gymnax has no step of six values."""
    if int(found.partition(".")[0]) < OLDEST_GYMNAX:
        how = f"pip install 'gymnax>={OLDEST_GYMNAX}'"
        raise ImportError(
            f"gymnax: found version {found}, expected {OLDEST_GYMNAX}.0 or newer: {how}"
        )


def import_gymnax() -> None:
    """Import gymnax without seaborn, which is imported once gymnax draws with it.

    seaborn imports pandas and scipy.stats, which takes as long as importing all else.

    Raises:
        ImportError: gymnax is too old.
    """
    check_gymnax(version("gymnax"))
    if DRAWS in sys.modules:
        return
    stand_in = ModuleType(DRAWS)
    stand_in.__dict__["__getattr__"] = lambda name: getattr(importlib.import_module(DRAWS), name)
    sys.modules[DRAWS] = stand_in
    try:
        importlib.import_module("gymnax")
    finally:
        del sys.modules[DRAWS]


def check_installed(extra: str, who: str, *modules: str) -> None:
    """Raise ImportError unless all these modules are installed; import none of them.

    Args:
        extra: of FlyTrack, which brings them.
        who: needs them, in the plural, for the message.

    Raises:
        ImportError: a module is not installed; the message names its package and the extra.
    """
    for module in modules:
        if not is_installed(module):
            package = PACKAGES.get(module, module)
            how = f"pip install 'flytrack[{extra}]'"
            raise ImportError(f"{who} need {package}, which is not installed: {how}", name=module)


def import_object(where: str, argument: str, error: type[Exception]) -> Any:
    """Return the object that ``module:name`` names; the working directory is searched first.

    Args:
        argument: whose value this is, for the message.
        error: what is raised where it cannot be imported.
    """
    module, _, name = where.partition(":")
    sys.path.insert(0, str(Path.cwd()))  # stays there: the module may import later
    try:
        return attrgetter(name)(importlib.import_module(module))
    except Exception as problem:  # whatever a user's module raises
        reason = f"{type(problem).__name__}: {problem}"
        raise error(f"{argument}: {where}: cannot be imported: {reason}") from problem
