"""The quadcopter's body in numbers: what ``body.c`` moves and a diagnosis is graded on."""

import dataclasses
import json
import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flytrack_env.files import read_at_most
from flytrack_env.messages import error_text, quote_name, quote_value

STEP_S = 125e-6  # of body.c
MOTORS = ("rear right", "front right", "rear left", "front left")  # Betaflight's order
STRONGEST_HEALTH = 1.5
MAX_TILT_RAD = 0.3
MAX_NUMBER = 1e6
MAX_BYTES = 2**20  # of a body's file


class FirmwareError(ValueError):
    """Firmware cannot be built, configured or flown; the message is one sentence that says what."""


@dataclass(frozen=True)
class Body:
    """A rigid body, four motors and a battery; x forward, y left, z up.

    The default is a 1 kg racer.

    A motor's speed follows its command c in [0, 1] with a lag; in the steady state its thrust is
    ``health * max_thrust_n * (linear c + (1 - linear) c^2) (V / full_v)^volt_exponent``. V is the
    voltage under load, the open one less ``resistance_ohm`` times a current that grows with the
    cube of the speeds.

    Assumption: rotors neither flap nor see each other's wake, and there is no ground.
    """

    mass_kg: float = 1.0
    gravity: float = 9.80665
    """m/s^2."""
    inertia: tuple[float, float, float] = (0.0035, 0.0035, 0.006)
    """About x, y, z, kg m^2."""
    arm_m: tuple[float, float] = (0.08, 0.08)
    """Of the motors, from the middle of the frame along x and y."""
    center_of_mass_m: tuple[float, float] = (0.0, 0.0)
    """From the middle of the frame along x and y."""
    thrust_tilt_rad: tuple[float, float] = (0.0, 0.0)
    """Of the motors' thrust, towards x and y."""
    max_thrust_n: float = 8.5875
    """Of one motor at full command and ``full_v``."""
    health: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    """Factor on each motor's thrust: rear right, front right, rear left, front left."""
    linear: float = 0.0
    """Linear share of the thrust curve, from 0 to 1; the rest is quadratic in the command."""
    lag_up_s: float = 0.018
    lag_down_s: float = 0.018
    """Time constants of a motor that speeds up, and of one that slows down."""
    torque_m: float = 0.016
    """Yaw torque per thrust, N m / N."""
    rotor_inertia: float = 0.017
    """Yaw torque of one motor per change of its speed, as a share of full speed, N m s."""
    linear_drag: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Body axes, N s/m."""
    quadratic_drag: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Body axes, N s^2/m^2."""
    rotor_drag: float = 0.0
    """Of the thrust, per edgewise speed, s/m."""
    translational_lift: float = 0.0
    """Share that thrust gains in fast edgewise flight."""
    full_v: float = 24.0
    volt_exponent: float = 1.4
    drain_v_per_min: float = 1.0
    """Of the open voltage."""
    resistance_ohm: float = 0.0
    """Of the battery."""
    full_current_a: float = 100.0
    """Of all motors at full speed."""
    gyro_noise: float = 0.0
    """Standard deviation of each sample, 8 kHz, before the firmware's filters, rad/s."""
    acc_noise: float = 0.0
    """m/s^2."""

    def __post_init__(self) -> None:
        """Refuse impossible numbers.

        Raises:
            FirmwareError: of a field; the message names it.
        """
        for field in dataclasses.fields(self):
            default: Any = field.default
            values, size = np.ravel(getattr(self, field.name)), np.size(default)
            is_number = values.dtype.kind in "fiu" and values.size == size
            if not is_number or not np.all(np.abs(values) < MAX_NUMBER):
                expected = "a finite number" if size == 1 else f"{size} finite numbers"
                raise FirmwareError(
                    f"body: {field.name}: found {getattr(self, field.name)}, expected {expected}"
                )
        for name, (text, is_good) in self._checks().items():
            if not is_good:
                raise FirmwareError(f"body: {name}: found {getattr(self, name)}, expected {text}")
        weight_n = self.mass_kg * self.gravity
        if self.full_thrust_n <= weight_n:
            found = f"found {self.full_thrust_n:g} N of all motors"
            raise FirmwareError(
                f"body: max_thrust_n: {found}, expected more than the weight, {weight_n:g} N"
            )

    def _checks(self) -> dict[str, tuple[str, bool]]:
        """Return what each field must be, and whether it is."""
        positive = "mass_kg gravity max_thrust_n full_v full_current_a lag_up_s lag_down_s"
        not_negative = (
            "linear_drag quadratic_drag rotor_drag translational_lift torque_m rotor_inertia "
            "volt_exponent drain_v_per_min resistance_ohm gyro_noise acc_noise"
        )
        checks = {name: ("more than 0", getattr(self, name) > 0) for name in positive.split()}
        checks |= {
            name: ("0 or more", np.min(getattr(self, name)) >= 0) for name in not_negative.split()
        }
        largest = max(self.inertia)
        is_solid = min(self.inertia) > 0 and largest <= sum(self.inertia) - largest
        inside = all(abs(c) < arm for c, arm in zip(self.center_of_mass_m, self.arm_m, strict=True))
        return checks | {
            "inertia": (
                "three of a solid body: each positive, none above the other two's sum",
                is_solid,
            ),
            "arm_m": ("more than 0", min(self.arm_m) > 0),
            "center_of_mass_m": ("within the arms", inside),
            "thrust_tilt_rad": (
                f"at most {MAX_TILT_RAD:g} either way",
                max(map(abs, self.thrust_tilt_rad)) <= MAX_TILT_RAD,
            ),
            "health": (
                f"four from 0 to {STRONGEST_HEALTH:g}",
                min(self.health) >= 0 and max(self.health) <= STRONGEST_HEALTH,
            ),
            "linear": ("0 to 1", 0 <= self.linear <= 1),
        }

    @property
    def full_thrust_n(self) -> float:
        """The thrust of all motors at full command and ``full_v``, N."""
        return sum(self.health) * self.max_thrust_n

    def command_of(self, speeds: np.ndarray, volts: np.ndarray) -> np.ndarray:
        """Return the mean command, (...) in [0, 1], of steady motors at these speeds, (..., 4).

        speeds: as shares of full speed. volts: (...) under load, V.
        """
        share = np.mean(speeds**2, axis=-1) / (volts / self.full_v) ** self.volt_exponent
        if self.linear == 1.0:
            return np.asarray(share)
        half, rest = 0.5 * self.linear, 1.0 - self.linear
        return (np.sqrt(half**2 + rest * share) - half) / rest

    def pack(self, is_reversed: bool) -> bytes:
        """Return the bytes of body.h's ``Body``.

        is_reversed: the firmware's ``yaw_motors_reversed``.
        """
        blends = [-math.expm1(-STEP_S / lag) for lag in (self.lag_up_s, self.lag_down_s)]
        numbers = [
            *(self.mass_kg, self.gravity, *self.inertia, *self.arm_m, *self.center_of_mass_m),
            *(*self.thrust_tilt_rad, self.max_thrust_n, *self.health, self.linear, *blends),
            *(self.torque_m, self.rotor_inertia, -1.0 if is_reversed else 1.0),
            *(*self.linear_drag, *self.quadratic_drag, self.rotor_drag, self.translational_lift),
            *(self.full_v, self.volt_exponent, self.drain_v_per_min / 60.0),
            *(self.resistance_ohm, self.full_current_a, self.gyro_noise, self.acc_noise),
        ]
        return struct.pack(f"={len(numbers)}d", *numbers)


def read_body(path: Path) -> Body:
    """Return the body in a file: a JSON object of fields of ``Body``; the rest are its defaults.

    Raises: FirmwareError: no such object, an unknown field or an impossible number; names the file
        and field. OSError: a file that cannot be read.
    """
    try:
        values = json.loads(read_at_most(path, MAX_BYTES))
    except ValueError as error:
        raise FirmwareError(f"{path}: found no JSON: {error_text(error)}") from error
    if not isinstance(values, dict):
        raise FirmwareError(
            f"{path}: found {quote_value(values)}, expected an object of fields of Body"
        )
    names = [field.name for field in dataclasses.fields(Body)]
    unknown = next((name for name in values if name not in names), None)
    if unknown is not None:
        raise FirmwareError(
            f"{path}: {quote_name(unknown)}: unknown, expected of {', '.join(names)}"
        )
    try:
        fields: dict[str, Any] = {
            name: tuple(v) if isinstance(v, list) else v for name, v in values.items()
        }
        return Body(**fields)
    except (FirmwareError, TypeError) as error:
        raise FirmwareError(f"{path}: {error_text(error)}") from error
