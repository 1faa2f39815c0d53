"""Packages that only an extra of FlyTrack brings: what is missing is told, and how to install it."""

from importlib.util import find_spec

PACKAGES = {"PIL": "Pillow", "pygame": "pygame-ce", "rerun": "rerun-sdk"}  # where the module's name differs


def check_installed(extra: str, who: str, *modules: str) -> None:
    """Raise an error unless every one of these modules is there to be imported; imports none of them.

    extra: of FlyTrack, which brings them. who: needs them, in the plural, for the message.

    Raises:
        ImportError: a module is not installed; the message names its package and the extra.
    """
    for module in modules:
        if find_spec(module) is None:
            package = PACKAGES.get(module, module)
            how = f"pip install 'flytrack[{extra}]'"
            raise ImportError(f"{who} need {package}, which is not installed: {how}", name=module)
