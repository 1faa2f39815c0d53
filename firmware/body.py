"""The quadcopter's body in numbers: what ``body.c`` moves and a diagnosis is graded on."""

import json
import math
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct, structs

from flytrack_env.files import read_at_most
from flytrack_env.messages import error_text
from flytrack_env.validation import convert

STEP_S = 125e-6  # of body.c
MOTORS = ("rear right", "front right", "rear left", "front left")  # Betaflight's order
MAX_NUMBER = 1e6
Number = Annotated[float, Meta(gt=-MAX_NUMBER, lt=MAX_NUMBER)]
Positive = Annotated[float, Meta(gt=0.0, lt=MAX_NUMBER)]
NotNegative = Annotated[float, Meta(ge=0.0, lt=MAX_NUMBER)]
Health = Annotated[float, Meta(ge=0.0, le=1.5)]
Tilt = Annotated[float, Meta(ge=-0.3, le=0.3)]
PerAxis = tuple[NotNegative, NotNegative, NotNegative]
MAX_BYTES = 2**20  # of a body's file


class FirmwareError(ValueError):
    """Firmware cannot be built, configured or flown; the message is one sentence that says what."""


class Body(Struct, frozen=True, forbid_unknown_fields=True):
    """A rigid body, four motors and a battery; x forward, y left, z up.

    The default is a 1 kg racer.

    A motor's speed follows its command c in [0, 1] with a lag; in the steady state its thrust is
    ``health * max_thrust_n * (linear c + (1 - linear) c^2) (V / full_v)^volt_exponent``. V is the
    voltage under load, the open one less ``resistance_ohm`` times a current that grows with the
    cube of the speeds.

    Assumption: rotors neither flap nor see each other's wake, and there is no ground.
    """

    mass_kg: Positive = 1.0
    gravity: Positive = 9.80665
    """m/s^2."""
    inertia: tuple[Positive, Positive, Positive] = (0.0035, 0.0035, 0.006)
    """About x, y, z, kg m^2."""
    arm_m: tuple[Positive, Positive] = (0.08, 0.08)
    """Of the motors, from the middle of the frame along x and y."""
    center_of_mass_m: tuple[Number, Number] = (0.0, 0.0)
    """From the middle of the frame along x and y."""
    thrust_tilt_rad: tuple[Tilt, Tilt] = (0.0, 0.0)
    """Of the motors' thrust, towards x and y."""
    max_thrust_n: Positive = 8.5875
    """Of one motor at full command and ``full_v``."""
    health: tuple[Health, Health, Health, Health] = (1.0, 1.0, 1.0, 1.0)
    """Factor on each motor's thrust: rear right, front right, rear left, front left."""
    linear: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    """Linear share of the thrust curve, from 0 to 1; the rest is quadratic in the command."""
    lag_up_s: Positive = 0.018
    lag_down_s: Positive = 0.018
    """Time constants of a motor that speeds up, and of one that slows down."""
    torque_m: NotNegative = 0.016
    """Yaw torque per thrust, N m / N."""
    rotor_inertia: NotNegative = 0.017
    """Yaw torque of one motor per change of its speed, as a share of full speed, N m s."""
    linear_drag: PerAxis = (0.0, 0.0, 0.0)
    """Body axes, N s/m."""
    quadratic_drag: PerAxis = (0.0, 0.0, 0.0)
    """Body axes, N s^2/m^2."""
    rotor_drag: NotNegative = 0.0
    """Of the thrust, per edgewise speed, s/m."""
    translational_lift: NotNegative = 0.0
    """Share that thrust gains in fast edgewise flight."""
    full_v: Positive = 24.0
    volt_exponent: NotNegative = 1.4
    drain_v_per_min: NotNegative = 1.0
    """Of the open voltage."""
    resistance_ohm: NotNegative = 0.0
    """Of the battery."""
    full_current_a: Positive = 100.0
    """Of all motors at full speed."""
    gyro_noise: NotNegative = 0.0
    """Standard deviation of each sample, 8 kHz, before the firmware's filters, rad/s."""
    acc_noise: NotNegative = 0.0
    """m/s^2."""

    def __post_init__(self) -> None:
        """Refuse impossible numbers.

        Raises:
            FirmwareError: of a field; the message names it.
        """
        for field in structs.fields(self):
            value = np.asarray(getattr(self, field.name)).tolist()
            convert("body", value, field.type, FirmwareError, field.name)
        largest, weight_n = max(self.inertia), self.mass_kg * self.gravity
        centers = zip(self.center_of_mass_m, self.arm_m, strict=True)
        checks = {
            "inertia": (
                largest <= sum(self.inertia) - largest,
                "none above the sum of the other two, as of a solid body",
            ),
            "center_of_mass_m": (all(abs(c) < arm for c, arm in centers), "within the arms"),
            "max_thrust_n": (
                self.full_thrust_n > weight_n,
                f"all motors above the weight, {weight_n:g} N",
            ),
        }
        for name, (is_good, expected) in checks.items():
            if not is_good:
                raise FirmwareError(
                    f"body: {name}: found {getattr(self, name)}, expected {expected}"
                )

    @property
    def full_thrust_n(self) -> float:
        """The thrust of all motors at full command and ``full_v``, N."""
        return sum(self.health) * self.max_thrust_n

    def command_of(self, speeds: np.ndarray, volts: np.ndarray) -> np.ndarray:
        """Return the mean command, (...) in [0, 1], of steady motors at these speeds, (..., 4).

        Args:
            speeds: as shares of full speed.
            volts: (...) under load, V.
        """
        share = np.mean(speeds**2, axis=-1) / (volts / self.full_v) ** self.volt_exponent
        if self.linear == 1.0:
            return np.asarray(share)
        half, rest = 0.5 * self.linear, 1.0 - self.linear
        return (np.sqrt(half**2 + rest * share) - half) / rest

    def pack(self, is_reversed: bool) -> bytes:
        """Return the bytes of body.h's ``Body``.

        Args:
            is_reversed: the firmware's ``yaw_motors_reversed``.
        """
        values = structs.asdict(self)  # body.h has the fields in the same order
        for name in ("lag_up_s", "lag_down_s"):
            values[name] = -math.expm1(-STEP_S / values[name])
        values["rotor_inertia"] = (self.rotor_inertia, -1.0 if is_reversed else 1.0)
        values["drain_v_per_min"] /= 60.0
        return (
            np.concatenate([np.ravel(value) for value in values.values()]).astype(float).tobytes()
        )


def read_body(path: Path) -> Body:
    """Return the body in a file: a JSON object of fields of ``Body``; the rest are its defaults.

    Raises: FirmwareError: no such object, an unknown field or an impossible number; names the file
        and field. OSError: a file that cannot be read.
    """
    try:
        values = json.loads(read_at_most(path, MAX_BYTES))
    except ValueError as error:
        raise FirmwareError(f"{path}: found no JSON: {error_text(error)}") from error
    return convert(str(path), values, Body, FirmwareError)
