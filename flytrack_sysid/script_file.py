"""Scripts: flights to fly, and their ``.npz`` files with an array for each field of ``Script``."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flytrack_env.files import write_atomically
from flytrack_env.messages import error_text
from flytrack_env.npz_file import NpzError, load_npz, npz_of
from flytrack_env.state import ACTION_SIZE, APPLIED_ACTION, QUATERNION, STATE_SIZE
from flytrack_sysid import excitation
from flytrack_sysid.manoeuvres import MANOEUVRES

SUFFIX = ".npz"
MAX_BYTES = 64 * 2**20  # in the file, and as float64: thousands of flights of 2.5 s
MAX_NORM_ERROR = 1e-3  # of a start's quaternion
ROUNDING = 1e-6  # of numbers converted from float32


class ScriptError(ValueError):
    """A script that cannot be flown, or a diagnosis that no script can be made from."""


class Script(NamedTuple):
    """Flights to fly.

    Attributes:
        kinds: names of manoeuvres, (N,).
        starts: states, (N, 21).
        commands: one each 0.01 s, (N, T, 4).
    """

    kinds: tuple[str, ...]
    starts: np.ndarray
    commands: np.ndarray


def build_script(flights: Iterable[excitation.ScriptedFlight]) -> Script:
    """Return the script of flights of equal length."""
    kinds, starts, commands = zip(*flights, strict=True)
    return Script(tuple(kinds), np.stack(starts).astype(float), np.stack(commands).astype(float))


def check_script(script: Script, source: str = "script") -> None:
    """Raise ScriptError unless a script can be flown; the message says source, flight and array."""
    kinds, starts, commands = script
    num_flights, (low, high) = len(kinds), excitation.SCRIPT_HEIGHTS
    is_shaped = starts.shape == (num_flights, STATE_SIZE) and commands.shape[::2] == (
        num_flights,
        ACTION_SIZE,
    )
    if (
        num_flights == 0
        or not is_shaped
        or commands.ndim != 3
        or commands.shape[1] < excitation.MIN_STEPS
    ):
        shapes = (
            f"{num_flights} kinds, starts of shape {starts.shape}, commands of shape "
            f"{commands.shape}"
        )
        min_steps = f"{excitation.MIN_STEPS} or more"
        expected = f"(N,), (N, {STATE_SIZE}) and (N, {min_steps}, {ACTION_SIZE}), N >= 1"
        raise ScriptError(f"{source}: found {shapes}, expected {expected}")
    norm_error = np.abs(np.linalg.norm(starts[:, QUATERNION], axis=1) - 1.0)
    envelope = f"at most {excitation.MAX_SPEED:g} m/s, {low:g} to {high:g} m, and a voltage"
    checks = {
        f"kinds: expected one of {', '.join(MANOEUVRES)}": np.isin(kinds, list(MANOEUVRES)),
        "starts: expected finite numbers": np.isfinite(starts).all(axis=1),
        "starts: expected an applied action within [-1, 1]": _are_sticks(starts[:, APPLIED_ACTION]),
        "starts: expected a quaternion of norm 1": norm_error <= MAX_NORM_ERROR,
        f"starts: expected a state within the envelope: {envelope}": excitation.is_inside(
            starts, excitation.SCRIPT_HEIGHTS, excitation.ANY_VOLTAGE
        ),
        "commands: expected numbers within [-1, 1]": _are_sticks(commands).all(axis=1),
    }
    for text, is_good in checks.items():
        if not is_good.all():
            raise ScriptError(f"{source}: flight {int(np.argmin(is_good))}: {text}")


def _are_sticks(values: np.ndarray) -> np.ndarray:
    return (np.abs(values) <= 1.0 + ROUNDING).all(axis=-1)  # false for NaN


def save_script(path: str | Path, script: Script) -> None:
    """Write a script to an ``.npz`` file, atomically; the same script gives the same bytes.

    Raises:
        ScriptError: ``load_script`` would refuse the script.
        OSError: the file cannot be written.
    """
    check_name(path)
    check_script(script, str(path))
    write_atomically(path, npz_of({**script._asdict(), "kinds": np.array(script.kinds)}))


def check_name(path: str | Path) -> None:
    """Raise ScriptError for a file name that ``save_script`` would refuse, without a script."""
    if Path(path).suffix.lower() != SUFFIX:
        raise ScriptError(f"{path}: found suffix {Path(path).suffix!r}, expected {SUFFIX}")


def load_script(path: str | Path) -> Script:
    """Return the script in an ``.npz`` file, or raise ScriptError. Nothing is unpickled."""
    check_name(path)
    try:
        arrays = load_npz(Path(path), MAX_BYTES)
    except (OSError, NpzError) as error:
        raise ScriptError(f"{path}: not a script, or damaged: {error_text(error)}") from error
    for name in Script._fields:
        if name not in arrays or arrays[name].dtype.kind not in ("U" if name == "kinds" else "iuf"):
            description = f"an array of {arrays[name].dtype}" if name in arrays else "none"
            raise ScriptError(
                f"{path}: {name}: found {description}, expected texts of kinds, else numbers"
            )
    kinds, starts, commands = (arrays[name] for name in Script._fields)
    script = Script(tuple(kinds.ravel().tolist()), starts.astype(float), commands.astype(float))
    check_script(script, str(path))
    return script
