"""What a log or its mapping states of the craft, and the nominal model that follows from it."""

from typing import Any, NamedTuple

import numpy as np

from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_sysid.log import LogError

NOMINAL_FULL_V = 24.0  # the voltage that the nominal thrust map is stated at (``nominal_parameters``)
VOLTAGE_TERMS = 4  # of the thrust map: from this coefficient on they multiply the voltage


class Craft(NamedTuple):
    """What is known of a craft; None where nothing is.

    max_rate_deg_s: (roll, pitch, yaw), body rate that a command of 1 means. mass_kg. voltage_v: (lowest,
    highest) in flight.
    """

    max_rate_deg_s: tuple[float, float, float] | None = None
    mass_kg: float | None = None
    voltage_v: tuple[float, float] | None = None

    def describe(self) -> str:
        """Return one line on the craft."""
        rates, volts = self.max_rate_deg_s, self.voltage_v
        parts = (
            f"full stick {', '.join(f'{rate:.4g}' for rate in rates)} deg/s"
            if rates
            else "full stick unknown",
            f"mass {self.mass_kg:g} kg" if self.mass_kg else "mass unknown",
            f"voltage {volts[0]:.4g} to {volts[1]:.4g} V" if volts else "voltage unknown",
        )
        return f"craft: {'; '.join(parts)}"


def nominal_model(craft: Craft, source: str) -> ModelParameters:
    """Return the generic racing quadcopter, scaled to a craft: where a fit may begin.

    Assumption: the nominal craft's lags, and its thrust-to-weight ratios at the same fractions of the
    highest voltage, so that thrust grows with the mass, and counts a volt more where there are fewer.
    source: the log or mapping, for messages.

    Raises:
        LogError: full-stick rates, mass or voltage are unknown.
    """
    if craft.max_rate_deg_s is None or craft.mass_kg is None or craft.voltage_v is None:
        name = next(name for name, value in craft._asdict().items() if value is None)
        raise LogError(f"{source}: craft.{name}: not in the log, and no mapping states it; a model needs it")
    nominal = nominal_parameters()
    per_volt = NOMINAL_FULL_V / craft.voltage_v[1]
    coeffs = np.asarray(nominal.thrust_coeffs, float) * craft.mass_kg / float(nominal.m)
    coeffs[VOLTAGE_TERMS:] *= per_volt
    leaves: dict[str, Any] = {  # of NumPy
        "thrust_coeffs": coeffs.astype(np.float32),
        "max_rate": np.asarray(craft.max_rate_deg_s, np.float32),
    }
    return nominal._replace(
        **leaves,
        m=craft.mass_kg,
        battery_drain_v_per_min=float(nominal.battery_drain_v_per_min) / per_volt,
    )
