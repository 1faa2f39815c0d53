"""One imported flight, and the craft that it is of."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flytrack_env.battery import Battery
from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.files import open_file
from flytrack_env.messages import error_text
from flytrack_env.motion import Motion
from flytrack_sysid.importing.file_kinds import NUM_BYTES, identify
from flytrack_sysid.log import FlightLog, LogError

VOLTAGE_TERMS = 4  # of the thrust map: from this coefficient on they multiply the voltage


class Craft(NamedTuple):
    """What a log or its mapping states of a craft; None where it states nothing.

    max_rate_deg_s: (roll, pitch, yaw), body rate at a command of 1. mass_kg. voltage_v: (lowest,
    highest) in flight.
    """

    max_rate_deg_s: tuple[float, float, float] | None = None
    mass_kg: float | None = None
    voltage_v: tuple[float, float] | None = None

    def describe(self) -> str:
        """Return one line on the craft."""
        rates = "full stick unknown"
        if self.max_rate_deg_s:
            rates = f"full stick {', '.join(f'{rate:.4g}' for rate in self.max_rate_deg_s)} deg/s"
        mass = f"mass {self.mass_kg:g} kg" if self.mass_kg else "mass unknown"
        volts = "voltage unknown"
        if self.voltage_v:
            volts = f"voltage {self.voltage_v[0]:.4g} to {self.voltage_v[1]:.4g} V"
        return f"craft: {rates}; {mass}; {volts}"

    def nominal_model(self, source: str) -> ModelParameters:
        """Return the generic racing quadcopter scaled to this craft: where a fit may start.

        Assumption: the nominal craft's lags, and its thrust-to-weight ratios at the same fractions
        of the highest voltage: thrust scales with the mass, and a volt counts for more where there
        are fewer. Raises LogError, with ``source``, where full-stick rates, mass or voltage are
        unknown.
        """
        if self.max_rate_deg_s is None or self.mass_kg is None or self.voltage_v is None:
            name = next(name for name, value in self._asdict().items() if value is None)
            raise LogError(f"{source}: craft.{name}: missing in log and mapping; a model needs it")
        nominal = nominal_parameters()
        empty_v, full_v = self.voltage_v
        per_volt = float(nominal.battery.full_v) / full_v
        coeffs = np.asarray(nominal.thrust_coeffs, float) * self.mass_kg / float(nominal.m)
        coeffs[VOLTAGE_TERMS:] *= per_volt
        leaves: dict[str, Any] = {  # of NumPy
            "thrust_coeffs": coeffs.astype(np.float32),
            "max_rate": np.asarray(self.max_rate_deg_s, np.float32),
        }
        return nominal._replace(
            **leaves,
            m=self.mass_kg,
            motion=Motion.CONTINUOUS,  # as drones move
            battery_drain_v_per_min=float(nominal.battery_drain_v_per_min) / per_volt,
            battery=Battery(full_v, empty_v, fitted_low_v=empty_v, fitted_high_v=full_v),
        )


class ImportedFlight(NamedTuple):
    """A flight as a reader returns it: its log, its craft, and notes for the user.

    craft: as the file and the mapping say.

    is_landed: rows at which the autopilot itself says that it is on the ground, (num_rows,) bool;
    None if it says nothing.
    """

    log: FlightLog
    craft: Craft = Craft()
    notes: tuple[str, ...] = ()
    is_landed: np.ndarray | None = None


def read_log_file(
    path: Path, most_bytes: int, first: bytes, expected: str, part: int | None = None
) -> bytes:
    """Return the content of a log file.

    Args:
        path: of the file.
        most_bytes: that it may have.
        first: the bytes that it begins with.
        expected: the kind of file in words.
        part: how many bytes of it are needed; all if None.

    Raises:
        LogError: it cannot be read, or is of another kind, which the message names.
    """
    try:
        with open_file(path, most_bytes) as file:
            content = file.read(max(part, NUM_BYTES) if part else most_bytes)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error_text(error)}") from error
    if not content.startswith(first):
        raise LogError(f"{path}: found {identify(content[:NUM_BYTES])}, expected {expected}")
    return content


def not_a_quadcopter(found: str) -> str:
    """Return the note on a craft that is none."""
    return (
        f"found {found}, not a quadcopter: thrust and rates stand for all rotors together, and for "
        "no wings"
    )


def saturation(is_at_end: np.ndarray) -> str:
    """Return the note on how often a motor is at its upper end, (num_rows,) bool.

    There, more cannot be commanded.
    """
    return f"a motor at its upper end in {np.mean(is_at_end):.2%} of the rows"
