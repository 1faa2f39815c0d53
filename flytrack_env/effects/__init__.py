"""Effects beyond the minimal model: the one explicit, ordered list, and how a model uses it.

The simulator folds them, the fit and the diagnosis free their parameters, domain randomisation draws
them, the documentation lists them. A new effect is a file here and a line in ``EFFECTS``.
"""

from typing import Any

import numpy as np

from flytrack_env.effects.accelerometer_bias import ACCELEROMETER_BIAS, AccelerometerBias
from flytrack_env.effects.accelerometer_scale import ACCELEROMETER_SCALE, AccelerometerScale
from flytrack_env.effects.base import STAGES, Effect, Range, StepContext
from flytrack_env.effects.command_delay import COMMAND_DELAY, CommandDelay
from flytrack_env.effects.ground_effect import GROUND_EFFECT, GroundEffect
from flytrack_env.effects.gyro_bias import GYRO_BIAS, GyroBias
from flytrack_env.effects.gyro_scale import GYRO_SCALE, GyroScale
from flytrack_env.effects.imu_latency import IMU_LATENCY, ImuLatency
from flytrack_env.effects.imu_offset import IMU_OFFSET, ImuOffset
from flytrack_env.effects.linear_drag import LINEAR_DRAG, LinearDrag
from flytrack_env.effects.motor_imbalance import MOTOR_IMBALANCE, MotorImbalance
from flytrack_env.effects.quadratic_drag import QUADRATIC_DRAG, QuadraticDrag
from flytrack_env.effects.rate_cross_coupling import RATE_CROSS_COUPLING, RateCrossCoupling
from flytrack_env.effects.rate_expo import RATE_EXPO, RateExpo
from flytrack_env.effects.rate_saturation import RATE_SATURATION, RateSaturation
from flytrack_env.effects.rate_scale import RATE_SCALE, RateScale
from flytrack_env.effects.rate_slew_limit import RATE_SLEW_LIMIT, RateSlewLimit
from flytrack_env.effects.rotor_drag import ROTOR_DRAG, RotorDrag
from flytrack_env.effects.second_order_rates import SECOND_ORDER_RATES, SecondOrderRates
from flytrack_env.effects.thrust_lag_asymmetry import THRUST_LAG_ASYMMETRY, ThrustLagAsymmetry
from flytrack_env.effects.thrust_scale import THRUST_SCALE, ThrustScale
from flytrack_env.effects.thrust_tilt import THRUST_TILT, ThrustTilt
from flytrack_env.effects.translational_lift import TRANSLATIONAL_LIFT, TranslationalLift
from flytrack_env.effects.voltage_sag import VOLTAGE_SAG, VoltageSag
from flytrack_env.effects.wind import WIND, Wind
from flytrack_env.effects.yaw_reaction import YAW_REACTION, YawReaction
from flytrack_env.state import Drone

# The order in which effects of one stage are folded, and that of a model's effects. What adds to the rates
# comes before the loop that remembers them; the latency comes before all that is wrong with its readings.
EFFECTS: tuple[Effect, ...] = (
    COMMAND_DELAY,
    THRUST_LAG_ASYMMETRY,
    RATE_EXPO,
    RATE_SCALE,
    RATE_SATURATION,
    YAW_REACTION,
    MOTOR_IMBALANCE,
    RATE_CROSS_COUPLING,
    SECOND_ORDER_RATES,
    RATE_SLEW_LIMIT,
    WIND,
    THRUST_SCALE,
    TRANSLATIONAL_LIFT,
    GROUND_EFFECT,
    LINEAR_DRAG,
    QUADRATIC_DRAG,
    ROTOR_DRAG,
    THRUST_TILT,
    VOLTAGE_SAG,
    IMU_LATENCY,
    IMU_OFFSET,
    ACCELEROMETER_SCALE,
    ACCELEROMETER_BIAS,
    GYRO_SCALE,
    GYRO_BIAS,
)
ROUNDING = 1e-5  # of float32 times
BY_NAME = {effect.name: effect for effect in EFFECTS}
_BY_CLASS = {effect.parameters: effect for effect in EFFECTS}


def effect_of(parameters: Any) -> Effect:
    """Return the effect that parameters belong to.

    Raises:
        TypeError: not the parameters of an effect.
    """
    effect = _BY_CLASS.get(type(parameters))
    if effect is None:
        names = ", ".join(effect.parameters.__name__ for effect in EFFECTS)
        raise TypeError(f"effect: found {type(parameters).__name__}, expected one of {names}")
    return effect


def check_parameters(parameters: Any, dt: Any) -> None:
    """Raise ValueError, naming effect and parameter, for concrete values beyond what the effect can do.

    dt: step of time, s.
    """
    effect = effect_of(parameters)
    for name, bounds in effect.ranges.items():
        value = np.asarray(getattr(parameters, name))
        longest = effect.most_steps.get(name, np.inf) * np.asarray(dt, float)
        high = np.minimum(bounds.high, longest)
        if not np.all((value >= bounds.low) & (value <= high * (1.0 + ROUNDING))):
            reason = f" at steps of {dt} s" if np.any(longest < bounds.high) else ""
            expected = f"{bounds.low:g} to {np.min(high):g} {bounds.unit}{reason}"
            raise ValueError(f"{effect.name}.{name}: found {value}, expected {expected}")


def merge(present: tuple[Any, ...], *added: Any) -> tuple[Any, ...]:
    """Return parameters of effects in the order of ``EFFECTS``; what is added replaces its like."""
    by_name = {effect_of(parameters).name: parameters for parameters in (*present, *added)}
    return tuple(by_name[effect.name] for effect in EFFECTS if effect.name in by_name)


def start_memories(effects: tuple[Any, ...], drone: Drone) -> tuple[Any, ...]:
    """Return what the effects of a model remember when an episode begins; None for most."""
    starts = ((effect_of(parameters).start, parameters) for parameters in effects)
    return tuple(start(parameters, drone) if start else None for start, parameters in starts)


def acts(effects: tuple[Any, ...], stage: str) -> bool:
    """Return whether any effect of a model acts at a stage (static)."""
    return any(stage in effect_of(parameters).stages for parameters in effects)


def fold(
    stage: str, effects: tuple[Any, ...], memories: tuple[Any, ...], value: Any, context: StepContext
) -> Any:
    """Return a stage's value after all effects of a model that act there, in order."""
    for parameters, memory in zip(effects, memories, strict=True):
        hook = getattr(effect_of(parameters), stage)
        if hook is not None:
            value = hook(parameters, memory, value, context)
    return value


def remember(effects: tuple[Any, ...], memories: tuple[Any, ...], context: StepContext) -> tuple[Any, ...]:
    """Return what the effects of a model remember after a step."""
    updates = ((effect_of(parameters).remember, parameters) for parameters in effects)
    pairs = zip(updates, memories, strict=True)
    return tuple(
        update(parameters, memory, context) if update else memory for (update, parameters), memory in pairs
    )


__all__ = [
    "BY_NAME",
    "EFFECTS",
    "STAGES",
    "AccelerometerBias",
    "AccelerometerScale",
    "CommandDelay",
    "Effect",
    "GroundEffect",
    "GyroBias",
    "GyroScale",
    "ImuLatency",
    "ImuOffset",
    "LinearDrag",
    "MotorImbalance",
    "QuadraticDrag",
    "Range",
    "RateCrossCoupling",
    "RateExpo",
    "RateSaturation",
    "RateScale",
    "RateSlewLimit",
    "RotorDrag",
    "SecondOrderRates",
    "StepContext",
    "ThrustLagAsymmetry",
    "ThrustScale",
    "ThrustTilt",
    "TranslationalLift",
    "VoltageSag",
    "Wind",
    "YawReaction",
    "acts",
    "check_parameters",
    "effect_of",
    "fold",
    "merge",
    "remember",
    "start_memories",
]
