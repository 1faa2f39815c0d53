"""Build and try the firmware.

Usage: ``flytrack firmware build [--sdist FILE]``, ``flytrack firmware check``.
"""

import hashlib
import time
from collections.abc import Sequence
from functools import partial

import numpy as np
import tyro

from firmware.body import Body
from firmware.building import build
from firmware.plant import DT_S, Betaflight
from flytrack.flags import OptionalPath
from flytrack_env.state import APPLIED_ACTION, BATTERY, POSITION, QUATERNION, STATE_SIZE

NUM_FLIGHTS, NUM_STEPS, HOLD_STEPS, SEED = 24, 250, 10, 0
LEVELS = (-1.0, -0.5, -0.25, 0.0, 0.25, 0.5, 1.0)
BODY = Body(gyro_noise=0.02, resistance_ohm=0.01)


def fixed_flights() -> tuple[np.ndarray, np.ndarray]:
    """Return starts (24, 21) and commands (24, 250, 4), of exact numbers only."""
    rng = np.random.default_rng(SEED)
    starts = np.zeros((NUM_FLIGHTS, STATE_SIZE), np.float32)
    starts[:, POSITION] = (0.0, 0.0, 60.0)
    starts[:, QUATERNION] = (1.0, 0.0, 0.0, 0.0)
    starts[:, APPLIED_ACTION] = (0.0, 0.0, 0.0, -0.25)
    starts[:, BATTERY] = 22.0 + rng.integers(0, 9, NUM_FLIGHTS) / 4.0
    levels = rng.integers(0, len(LEVELS), (NUM_FLIGHTS, NUM_STEPS // HOLD_STEPS, 4))
    return starts, np.repeat(np.array(LEVELS, np.float32)[levels], HOLD_STEPS, axis=1)


def check() -> str:
    """Fly the set twice and return a line: the hash, whether both are the same, the speed.

    The hash is the same on every machine, unless a build differs.
    """
    starts, commands = fixed_flights()
    with Betaflight(body=BODY) as plant:
        first = plant.fly(starts, commands)
        began = time.perf_counter()
        again = plant.fly(starts, commands)
        elapsed_s = time.perf_counter() - began
    same = "the same twice" if np.array_equal(first, again) else "NOT the same twice"
    speed = NUM_FLIGHTS * NUM_STEPS * DT_S / elapsed_s
    digest = hashlib.sha256(first.tobytes()).hexdigest()[:16]
    return f"{NUM_FLIGHTS} flights: {digest}, {same}; {speed:.0f} times real time"


def print_check() -> None:
    """Fly a fixed set of flights twice: their hash, and the speed."""
    print(check())


def print_build(sdist: OptionalPath = None) -> None:
    """Download by hash and compile, in the user's cache folder.

    Args:
        sdist: The source distribution, if it is downloaded already.
    """
    build(partial(print, flush=True), sdist)


def main(words: Sequence[str]) -> None:
    """Do as the words after ``flytrack firmware`` say."""
    tyro.extras.subcommand_cli_from_dict(
        {"build": print_build, "check": print_check},
        args=words,
        prog="flytrack firmware",
        description="Betaflight in the loop.",
    )
