"""One imported flight, and its craft."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flytrack_env.battery import Battery
from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.effects import Motors
from flytrack_env.files import open_file
from flytrack_env.messages import error_text, quote_name
from flytrack_env.motion import Motion
from flytrack_sysid.importing.file_kinds import NUM_BYTES, identify
from flytrack_sysid.log import FlightLog, LogError
from flytrack_sysid.log_table import Table, columns_of, log_of_table

MAX_LIST_LENGTH = 1000  # characters of a list of names in a message


class Craft(NamedTuple):
    """The properties of a craft that a log or its mapping states; None where it states none.

    Attributes:
        max_rate_deg_s: body rates of roll, pitch and yaw at a command of 1.
        mass_kg: mass.
        voltage_v: lowest and highest voltage in flight.
        motors: the frame, where the commands are those of motors.
    """

    max_rate_deg_s: tuple[float, float, float] | None = None
    mass_kg: float | None = None
    voltage_v: tuple[float, float] | None = None
    motors: Motors | None = None

    def describe(self) -> str:
        """Return one line on the craft."""
        rates = "full stick unknown" if self.motors is None else "commands of motors"
        if self.max_rate_deg_s:
            rates = f"full stick {', '.join(f'{rate:.4g}' for rate in self.max_rate_deg_s)} deg/s"
        mass = f"mass {self.mass_kg:g} kg" if self.mass_kg else "mass unknown"
        volts = "voltage unknown"
        if self.voltage_v:
            volts = f"voltage {self.voltage_v[0]:.4g} to {self.voltage_v[1]:.4g} V"
        return f"craft: {rates}; {mass}; {volts}"

    def as_json(self) -> dict[str, Any]:
        """Return what is known as JSON values; without the frame of motors where there is none."""
        values = self._asdict()
        motors = values.pop("motors")
        return values if motors is None else {**values, "motors": motors._asdict()}

    def nominal_model(self, source: str) -> ModelParameters:
        """Return the generic racing quadcopter scaled to this craft, as a start for fits.

        Assumption: the craft has the nominal craft's lags, and its thrust-to-weight ratios at the
        same fractions of the highest voltage.

        Args:
            source: the log, for messages.

        Raises:
            LogError: full-stick rates, mass or voltage are unknown.
        """
        nominal = nominal_parameters()
        max_rate = self.max_rate_deg_s
        if max_rate is None and self.motors is not None:  # a unit of its observations only
            max_rate = tuple(nominal.max_rate.tolist())
        if max_rate is None or self.mass_kg is None or self.voltage_v is None:
            needed = self._replace(max_rate_deg_s=max_rate)
            name = next(name for name in Craft._fields if getattr(needed, name) is None)
            raise LogError(f"{source}: craft.{name}: missing in log and mapping; a model needs it")
        empty_v, full_v = self.voltage_v
        battery = Battery(full_v, empty_v, fitted_low_v=empty_v, fitted_high_v=full_v)
        model = nominal.resized(self.mass_kg, battery)._replace(
            max_rate=np.asarray(max_rate, np.float32),
            motion=Motion.CONTINUOUS,  # as drones move
        )
        return model if self.motors is None else model.with_effects(self.motors)


class ImportedFlight(NamedTuple):
    """A flight as a reader returns it.

    Attributes:
        log: of the flight.
        craft: as file and mapping state it.
        notes: for the user.
        is_landed: rows at which the autopilot reports that it is on the ground, (num_rows,) bool;
            None if it does not report it.
    """

    log: FlightLog
    craft: Craft
    notes: tuple[str, ...]
    is_landed: np.ndarray | None = None


def log_of_channels(
    table: Table,
    time: np.ndarray,
    segment: np.ndarray,
    channels: Mapping[str, np.ndarray],
    has_motors: bool,
) -> FlightLog:
    """Return the log of channels of ``CHANNELS``, (num_rows, n) each, which is checked.

    Args:
        table: the source and its lines, for messages.
        time: (num_rows,) s.
        segment: of each row, (num_rows,).
        channels: by name.
        has_motors: whether the commands are those of motors.
    """
    columns = {**columns_of(time, channels), "segment": segment}
    return replace(log_of_table(table._replace(columns=columns)), has_motors=has_motors)


def list_names(names: Iterable[str]) -> str:
    """Return names of a file for a message, as many as fit."""
    return ", ".join(map(quote_name, names))[:MAX_LIST_LENGTH]


def read_log_file(
    path: Path, max_bytes: int, first: bytes, expected: str, is_whole: bool = True
) -> bytes:
    """Return the content of a log file.

    Args:
        path: of the file.
        max_bytes: maximum size of the file.
        first: the bytes with which it begins.
        expected: the kind of file in words.
        is_whole: whether all bytes are needed, not only those that show the kind.

    Raises:
        LogError: the file cannot be read, or is of another kind, which the message names.
    """
    try:
        with open_file(path, max_bytes) as file:
            content = file.read(max_bytes if is_whole else NUM_BYTES)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error_text(error)}") from error
    if not content.startswith(first):
        raise LogError(f"{path}: found {identify(content[:NUM_BYTES])}, expected {expected}")
    return content


def not_a_quadcopter(craft: str) -> str:
    """Return the note on a craft that is no quadcopter."""
    return (
        f"found {craft}, not a quadcopter: thrust and rates stand for all rotors together, and for "
        "no wings"
    )


def saturation(is_at_end: np.ndarray) -> str:
    """Return the note on how often a motor is at its upper end and cannot give more thrust.

    Args:
        is_at_end: rows where a motor is at its upper end, (num_rows,) bool.
    """
    return f"a motor at its upper end in {np.mean(is_at_end):.2%} of the rows"
