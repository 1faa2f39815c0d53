"""Write a policy for the drone itself: ``flytrack export CHECKPOINT --c policy.h``.

The files take the drone's state and the gate to fly, and give the stick commands (docs/export.md).
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from baselines.purejaxrl_ppo.checkpoint import load_checkpoint
from baselines.purejaxrl_ppo.export_c import c_of
from baselines.purejaxrl_ppo.export_onnx import onnx_of
from baselines.purejaxrl_ppo.export_policy import policy_of
from flytrack_env.files import write_atomically

PROG = "flytrack export"


@dataclasses.dataclass(frozen=True)
class ExportSettings:
    """Write a policy as an ONNX file, a C header, or both; existing files are replaced."""

    checkpoint: tyro.conf.Positional[Path]
    """Checkpoint of a training: final.safetensors."""
    onnx: Path | None = None
    """Write an ONNX file."""
    c: Path | None = None
    """Write a C99 header."""
    track: str | None = None
    """Name or file of the track whose gates are built in; by default the checkpoint's."""
    float64: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Compute in float64 inside the ONNX file: it rounds less, but not every runtime can."""

    def check(self) -> None:
        """Raise ValueError, naming the flag, for settings that cannot be used."""
        paths = [path.resolve() for path in (self.checkpoint, self.onnx, self.c) if path is not None]
        if len(paths) == 1:
            raise ValueError("--onnx, --c: found neither, expected a file to write")
        if len(set(paths)) < len(paths):
            raise ValueError("--onnx, --c: found a file that is read or written twice, expected another")
        if self.float64 and self.onnx is None:
            raise ValueError("--float64: found no --onnx, expected one: a C header is float32")


def export(settings: ExportSettings) -> list[Path]:
    """Write the files that the settings ask for, each as a whole or not at all; return their paths.

    Raises:
        ValueError, ImportError, OSError: settings, packages or files that cannot be used.
    """
    settings.check()
    policy = policy_of(load_checkpoint(settings.checkpoint), settings.checkpoint.name, settings.track)
    contents = {}  # all of them before any is written
    if settings.onnx is not None:
        contents[settings.onnx] = onnx_of(policy, settings.float64)
    if settings.c is not None:
        contents[settings.c] = c_of(policy)
    for path, content in contents.items():
        write_atomically(path, content)
    return list(contents)


def main(arguments: Sequence[str] | None = None) -> None:
    """Export as the command line says, and print what was written."""
    settings = tyro.cli(ExportSettings, args=arguments, prog=PROG)
    try:
        for path in export(settings):
            print(f"{path}: {path.stat().st_size} bytes")
    except (ImportError, ValueError, OSError) as error:
        print(f"{PROG}: error: {error}", file=sys.stderr)
        raise SystemExit(2) from error


if __name__ == "__main__":
    main()
