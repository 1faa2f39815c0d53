"""Scripts: flights to be flown, and the files that hold them.

==========  ==============  ==================================================================
array       shape           what it is
==========  ==============  ==================================================================
kinds       (N,) text       what each flight is, a name of ``flytrack_sysid.manoeuvres``
starts      (N, 21)         the handout's state at the start of each, within the envelope
commands    (N, T, 4)       commands in [-1, 1], one per 0.01 s
==========  ==============  ==================================================================
"""

import io
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flytrack_env.files import write_atomically
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_env.npz_file import NpzError, load_npz
from flytrack_env.state import ACTION_SIZE, APPLIED_ACTION, QUATERNION, STATE_SIZE
from flytrack_sysid.envelope import ANY_VOLTAGE, FEWEST_STEPS, LARGEST_SPEED, SCRIPT_HEIGHTS, is_inside
from flytrack_sysid.excitation import ScriptedFlight
from flytrack_sysid.manoeuvres import MANOEUVRES

SUFFIX = ".npz"
ARRAYS = ("kinds", "starts", "commands")
LARGEST_BYTES = 64 * 2**20  # in the file, and as float64: thousands of flights of 2.5 s
LONGEST_LIST = 200  # characters of names that are not expected
LARGEST_NORM_ERROR = 1e-3  # of a start's quaternion
ROUNDING = 1e-6  # of numbers that were float32


class ScriptError(ValueError):
    """A script that cannot be flown, or a diagnosis that no script can be made from."""


class Script(NamedTuple):
    """Flights to be flown: kinds (N,), starts (N, 21), commands (N, T, 4); float64."""

    kinds: tuple[str, ...]
    starts: np.ndarray
    commands: np.ndarray


def script_of(flights: Iterable[ScriptedFlight]) -> Script:
    """Return the script of flights of equal length."""
    kinds, starts, commands = zip(*flights, strict=True)
    return Script(tuple(kinds), np.stack(starts).astype(float), np.stack(commands).astype(float))


def check_name(path: str | Path) -> None:
    """Raise ScriptError for a file that is not .npz, before there is a script."""
    if Path(path).suffix.lower() != SUFFIX:
        raise ScriptError(f"{path}: found suffix {Path(path).suffix!r}, expected {SUFFIX}")


def check_script(script: Script, source: str = "script") -> None:
    """Raise ScriptError unless a script can be flown; the message names source, array and flight."""
    kinds, starts, commands = script
    number = len(kinds)
    if number == 0:
        raise ScriptError(f"{source}: kinds: found no flight, expected at least one")
    if starts.shape != (number, STATE_SIZE):
        raise ScriptError(f"{source}: starts: found shape {starts.shape}, expected ({number}, {STATE_SIZE})")
    if commands.ndim != 3 or commands.shape[::2] != (number, ACTION_SIZE) or commands.shape[1] < FEWEST_STEPS:
        expected = f"({number}, {FEWEST_STEPS} or more, {ACTION_SIZE})"
        raise ScriptError(f"{source}: commands: found shape {commands.shape}, expected {expected}")
    for name, values in (("starts", starts), ("commands", commands)):
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            place = tuple(bad[0].tolist())
            raise ScriptError(
                f"{source}: {name}{list(place)}: found {values[place]}, expected a finite number"
            )
    unknown = [kind for kind in kinds if kind not in MANOEUVRES]
    if unknown:
        raise ScriptError(
            f"{source}: kinds: found {quote_value(unknown[0])}, expected one of {', '.join(MANOEUVRES)}"
        )
    _check_ranges(starts, commands, source)


def _check_ranges(starts: np.ndarray, commands: np.ndarray, source: str) -> None:
    for name, sticks in (("starts (applied action)", starts[:, APPLIED_ACTION]), ("commands", commands)):
        bad = np.argwhere(np.abs(sticks) > 1.0 + ROUNDING)
        if len(bad):
            found = sticks[tuple(bad[0])]
            raise ScriptError(f"{source}: {name}: found {found:g} in flight {bad[0][0]}, expected -1 to 1")
    norm = np.linalg.norm(starts[:, QUATERNION], axis=1)
    for flight in np.flatnonzero(np.abs(norm - 1.0) > LARGEST_NORM_ERROR):
        found = f"a quaternion of norm {norm[flight]:.4g}"
        raise ScriptError(f"{source}: starts: found {found} in flight {flight}, expected 1")
    low, high = SCRIPT_HEIGHTS
    for flight in np.flatnonzero(~is_inside(starts, SCRIPT_HEIGHTS, ANY_VOLTAGE)):
        expected = f"at most {LARGEST_SPEED:g} m/s, {low:g} to {high:g} m, a voltage"
        raise ScriptError(
            f"{source}: starts: found flight {flight} outside of the envelope, expected {expected}"
        )


def save_script(path: str | Path, script: Script) -> None:
    """Write a script to an ``.npz`` file, atomically; the same script gives the same bytes.

    Raises:
        ScriptError: another suffix, or a script that ``load_script`` would refuse.
        OSError: what the system says.
    """
    check_name(path)
    check_script(script, str(path))
    buffer = io.BytesIO()
    arrays = {"kinds": np.array(script.kinds), "starts": script.starts, "commands": script.commands}
    np.savez(buffer, allow_pickle=False, **arrays)
    write_atomically(path, buffer.getvalue())


def load_script(path: str | Path) -> Script:
    """Return the script in an ``.npz`` file. Nothing is unpickled.

    Raises:
        ScriptError: a file that cannot be read, or no script that can be flown; the message says why.
    """
    check_name(path)
    path = Path(path)
    try:
        arrays = load_npz(path, LARGEST_BYTES)
    except (OSError, NpzError) as error:
        raise ScriptError(f"{path}: not a script, or damaged: {error_text(error)}") from error
    if sorted(arrays) != sorted(ARRAYS):
        found = ", ".join(map(quote_name, sorted(arrays)))[:LONGEST_LIST]
        raise ScriptError(f"{path}: found arrays {found}, expected {', '.join(ARRAYS)}")
    kinds, starts, commands = (arrays[name] for name in ARRAYS)
    if kinds.ndim != 1 or kinds.dtype.kind != "U" or starts.ndim != 2 or len(kinds) != len(starts):
        found = f"arrays of {kinds.dtype}, shape {kinds.shape}, and of shape {starts.shape}"
        raise ScriptError(f"{path}: kinds, starts: found {found}, expected a name for each start")
    for name, values in (("starts", starts), ("commands", commands)):
        if values.dtype.kind not in "iuf":
            raise ScriptError(f"{path}: {name}: found an array of {values.dtype}, expected numbers")
    script = Script(tuple(kinds.tolist()), starts.astype(float), commands.astype(float))
    check_script(script, str(path))
    return script
