"""Modules that only some logs need."""

import importlib
from pathlib import Path
from types import ModuleType

from flytrack_sysid.log import LogError


def needed_module(name: str, extra: str, path: Path) -> ModuleType:
    """Return a module that an extra of the package brings.

    path: the file that needs it, for the message.

    Raises:
        LogError: it is not installed; the message names the extra.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        how = f"pip install 'flytrack[{extra}]'"
        raise LogError(f"{path}: needs the package {name}, which is not installed: {how}") from error
