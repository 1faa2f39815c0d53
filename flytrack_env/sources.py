"""A digest of FlyTrack's source code, as its version is that of many commits."""

import functools
import hashlib
from pathlib import Path

PACKAGES = ("flytrack", "flytrack_env", "flytrack_sysid", "flytrack_loop", "flytrack_bench")


@functools.cache
def digest_of_sources(*packages: str) -> str:
    """Return a digest of packages that are installed beside this one.

    Args:
        packages: names, or folders in them; none: all of FlyTrack but its baselines.
    """
    digest, root = hashlib.sha256(), Path(__file__).parents[1]
    for package in packages or PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            content = path.read_bytes()
            digest.update(f"{path.relative_to(root).as_posix()} {len(content)}\n".encode())
            digest.update(content)
    return digest.hexdigest()[:16]
