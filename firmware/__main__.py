"""Build and try the firmware: ``flytrack firmware build [--sdist FILE]``, ``flytrack firmware check``."""

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from firmware.building import build
from firmware.checking import check
from firmware.errors import FirmwareError


def main(arguments: Sequence[str] | None = None) -> int:
    """Do as the command line says; return the exit status."""
    parser = argparse.ArgumentParser(prog="flytrack firmware", description="Betaflight in the loop.")
    commands = parser.add_subparsers(required=True, dest="command")
    commands.add_parser("check", help="fly a fixed set of flights twice: their hash, and the speed")
    command = commands.add_parser("build", help="download by hash and compile, in the user's cache folder")
    command.add_argument("--sdist", type=Path, help="the source distribution, if it is downloaded already")
    try:
        asked = parser.parse_args(arguments)
        if asked.command == "check":
            print(check())
        else:
            build(partial(print, flush=True), asked.sdist)
    except (FirmwareError, OSError) as error:
        print(f"flytrack firmware: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
