"""Betaflight in the loop: the real firmware, built on this machine, as a plant (docs/firmware.md).

The Python here and ``body.c`` are under Apache-2.0. ``lockstep.c``, and the program that ``flytrack
firmware build`` makes, are under GPL-3.0-or-later (``firmware/LICENSE``); it runs in processes of
its own.
"""

from firmware.body import Body, FirmwareError, read_body
from firmware.building import build
from firmware.plant import Betaflight, FirmwareState

__all__ = ["Betaflight", "Body", "FirmwareError", "FirmwareState", "build", "read_body"]
