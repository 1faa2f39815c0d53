"""What each cause is in plain words, and the plot that shows it: which residual against what."""

from collections.abc import Sequence
from typing import NamedTuple

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import ThrustScale
from flytrack_sysid.diagnosis.candidates import BASE_CAUSES
from flytrack_sysid.parameters import STICKS, names_of, to_vector, with_values


class Against(NamedTuple):
    """A panel: means of a residual by bins of a regressor, names as in ``traces``."""

    residual: str
    regressor: str


class After(NamedTuple):
    """A panel: mean residual after a change of a command. only: 1 where it rises, -1 where it falls."""

    residual: str
    stick: str
    only: int = 0


class Evidence(NamedTuple):
    """A cause in plain words, its panels, and how they show it."""

    words: str
    panels: tuple[Against | After, ...]
    reading: str


def _against(residual: str, regressor: str, axes: str = "xyz") -> tuple[Against, ...]:
    return tuple(Against(f"{residual}_{axis}", f"{regressor}_{axis}") for axis in axes)


def _all_against(residual: str, regressor: str, axes: str = "xyz") -> tuple[Against, ...]:
    return tuple(Against(f"{residual}_{axis}", regressor) for axis in axes)


_TURNS = (After("rates_x", "roll"), After("rates_y", "pitch"), After("rates_z", "yaw"))
_LATE = (*_TURNS[:2], After("force_z", "thrust"))
_BY_STICK = tuple(
    Against(f"rates_{axis}", f"applied_{stick}") for axis, stick in zip("xyz", STICKS[:3], strict=True)
)
_BY_AIRSPEED = _against("force", "airspeed")
_LATE_READING = (
    "Averaged over all steps of the command: the error is a kick that dies out once the drone has answered."
)
_GYRO = _against("rates", "model_rates") + _against("attitude", "model_rates")
_GYRO_READING = "It shows in the gyro (above) and not in the turn of the attitude (below)."
_ACCELEROMETER = _against("force", "model_force") + _against("velocity", "model_force")
_ACCELEROMETER_READING = "It shows in the accelerometer (above) and not in the change of velocity (below)."

EVIDENCE: dict[str, Evidence] = {
    "command_delay": Evidence("all commands act late", _LATE, _LATE_READING),
    "thrust_lag_asymmetry": Evidence(
        "thrust falls faster or slower than it rises",
        (After("force_z", "thrust", 1), After("force_z", "thrust", -1)),
        "The error after rising commands differs from that after falling ones.",
    ),
    "rate_expo": Evidence(
        "the sticks have a cubic curve", _BY_STICK, "The error bends back to nothing at full stick."
    ),
    "rate_scale": Evidence(
        "maximum body rates differ", _BY_STICK, "The error grows in proportion to the stick."
    ),
    "rate_saturation": Evidence(
        "body rates saturate before full stick",
        _BY_STICK,
        "No error near the centre, a steep rise.",
    ),
    "yaw_reaction": Evidence(
        "yaw is kicked when thrust changes",
        (Against("rates_z", "thrust_change"),),
        "The yaw rate is off in proportion to how fast the thrust changes.",
    ),
    "motor_imbalance": Evidence(
        "roll and pitch creep with thrust",
        _all_against("rates", "model_force_z", "xy"),
        "The error of the rate grows with thrust, whatever the sticks do.",
    ),
    "rate_cross_coupling": Evidence(
        "roll and pitch leak into yaw",
        (Against("rates_z", "model_rates_x"), Against("rates_z", "model_rates_y")),
        "The yaw rate is off in proportion to the rates about the other axes.",
    ),
    "second_order_rates": Evidence("the rate loop has a second lag", _TURNS, _LATE_READING),
    "rate_slew_limit": Evidence(
        "body rates change no faster than a limit",
        _against("rates", "spin_up"),
        "No error at gentle demands; beyond the limit it grows with the demand.",
    ),
    "wind": Evidence(
        "steady wind",
        _all_against("force_world", "heading"),
        "The push keeps its direction in the world, whatever the heading.",
    ),
    "thrust_scale": Evidence(
        "all thrust is scaled (or the mass differs)",
        (Against("force_z", "model_force_z"),),
        "The error grows in proportion to thrust.",
    ),
    "translational_lift": Evidence(
        "thrust gained in fast edgewise flight",
        (Against("force_z", "airspeed_xy"),),
        "The error along the thrust axis grows with airspeed in the rotor plane and levels off.",
    ),
    "ground_effect": Evidence(
        "thrust gained near the ground",
        (Against("force_z", "height"),),
        "The error appears only near the ground.",
    ),
    "linear_drag": Evidence(
        "drag in proportion to airspeed", _BY_AIRSPEED, "A force against the motion, on a straight line."
    ),
    "quadratic_drag": Evidence(
        "drag with the square of airspeed",
        _BY_AIRSPEED,
        "A force against the motion that bends: slow flight hides it.",
    ),
    "rotor_drag": Evidence(
        "rotor drag, in proportion to thrust and airspeed",
        _against("force", "airspeed", "xy"),
        "A force against the motion in the rotor plane.",
    ),
    "thrust_tilt": Evidence(
        "the thrust axis leans",
        _all_against("force", "model_force_z", "xy"),
        "A sideways force in proportion to thrust.",
    ),
    "voltage_sag": Evidence(
        "the battery sags under load",
        (Against("battery", "applied_thrust"),),
        "The voltage falls with thrust and comes back.",
    ),
    "imu_latency": Evidence(
        "gyro and accelerometer are late",
        (*_TURNS[:2], After("attitude_x", "roll"), After("attitude_y", "pitch")),
        "The gyro lags behind (above), as the accelerometer does; the attitude does not (below).",
    ),
    "imu_offset": Evidence(
        "the accelerometer is off the centre of mass",
        _against("force", "turning"),
        "The error grows with the square of the body rates.",
    ),
    "accelerometer_scale": Evidence(
        "the accelerometer's scale is off", _ACCELEROMETER, _ACCELEROMETER_READING
    ),
    "accelerometer_bias": Evidence("the accelerometer has an offset", _ACCELEROMETER, _ACCELEROMETER_READING),
    "gyro_scale": Evidence("the gyro's scale is off", _GYRO, _GYRO_READING),
    "gyro_bias": Evidence("the gyro has an offset", _GYRO, _GYRO_READING),
    "tau_roll": Evidence("the lag of roll differs", _TURNS[:1], _LATE_READING),
    "tau_pitch": Evidence("the lag of pitch differs", _TURNS[1:2], _LATE_READING),
    "tau_yaw": Evidence("the lag of yaw differs", _TURNS[2:], _LATE_READING),
    "tau_thrust": Evidence("the lag of thrust differs", _LATE[2:], _LATE_READING),
    "thrust_curve": Evidence(
        "the thrust curve differs",
        (Against("force_z", "applied_thrust"),),
        "The error along the thrust axis follows the thrust action.",
    ),
    "battery_drain": Evidence(
        "the battery drains faster or slower",
        (Against("battery", "time"),),
        "The voltage drifts away from the model's, evenly in time.",
    ),
}


def without(extended: ModelParameters, nominal: ModelParameters, cause: str) -> ModelParameters:
    """Return a model less one cause: effect or base parameters as in the nominal model.

    Raises:
        KeyError: no cause of that name.
    """
    if cause == "thrust_scale" and all(type(one) is not ThrustScale for one in extended.effects):
        cause = "thrust_curve"  # found as one factor between two curves
    if cause not in BASE_CAUSES:
        return extended.with_effects(nominal.effect(cause))
    before = dict(zip(names_of(nominal), to_vector(nominal).tolist(), strict=True))
    return with_values(extended, {name: before[name] for name in BASE_CAUSES[cause]})


def words_of(cause: str) -> str:
    """Return a cause in plain words; its own name where there are none."""
    return EVIDENCE[cause].words if cause in EVIDENCE else cause.replace("_", " ")


def list_words(causes: Sequence[str]) -> str:
    """Return causes in plain words, as a list in a sentence."""
    return "; ".join(words_of(cause) for cause in causes)
