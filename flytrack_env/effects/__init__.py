"""Effects beyond the minimal model: the one explicit, ordered list, and how a model uses it.

The simulator folds them, the fit and the diagnosis free their parameters, domain randomisation
draws them, the documentation lists them. A new effect is a file here and a line in ``EFFECTS``.
"""

from typing import Any

import jax
import numpy as np

from flytrack_env.effects.accelerometer_bias import ACCELEROMETER_BIAS, AccelerometerBias
from flytrack_env.effects.accelerometer_scale import ACCELEROMETER_SCALE, AccelerometerScale
from flytrack_env.effects.actual_rates import ACTUAL_RATES, ActualRates
from flytrack_env.effects.base import (
    STAGES,
    CommandContext,
    Effect,
    Effects,
    Memories,
    Pose,
    Range,
    Rates,
    RatesContext,
    StepContext,
)
from flytrack_env.effects.betaflight_loop import BETAFLIGHT_LOOP, BetaflightLoop
from flytrack_env.effects.betaflight_rates import BETAFLIGHT_RATES, BetaflightRates
from flytrack_env.effects.command_delay import (
    COMMAND_DELAY,
    DEFAULT_DELAY_STEPS,
    MAX_DELAY_STEPS,
    CommandDelay,
)
from flytrack_env.effects.grammar import Flight
from flytrack_env.effects.ground_effect import GROUND_EFFECT, GroundEffect
from flytrack_env.effects.gyro_bias import GYRO_BIAS, GyroBias
from flytrack_env.effects.gyro_scale import GYRO_SCALE, GyroScale
from flytrack_env.effects.imu_latency import IMU_LATENCY, ImuLatency
from flytrack_env.effects.imu_offset import IMU_OFFSET, ImuOffset
from flytrack_env.effects.learned_law import LEARNED_LAW, LearnedLaw
from flytrack_env.effects.linear_drag import LINEAR_DRAG, LinearDrag
from flytrack_env.effects.mocap_latency import MOCAP_LATENCY, MocapLatency
from flytrack_env.effects.motor_imbalance import MOTOR_IMBALANCE, MotorImbalance
from flytrack_env.effects.motors import MOTORS, Motors, as_commanded
from flytrack_env.effects.quadratic_drag import QUADRATIC_DRAG, QuadraticDrag
from flytrack_env.effects.quick_rates import QUICK_RATES, QuickRates
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
from flytrack_env.quaternion import Scalar
from flytrack_env.state import Drone

# The order in which effects of one stage are folded, and that of a model's effects. Commands pass
# as in a flight controller: the link, the stick's curve, its limit, the limit on acceleration. What
# adds to the rates comes before the loop that remembers them; the latency comes before all that is
# wrong with its readings.
EFFECTS: tuple[Effect, ...] = (
    COMMAND_DELAY,
    ACTUAL_RATES,
    BETAFLIGHT_RATES,
    QUICK_RATES,
    RATE_EXPO,
    RATE_SATURATION,
    RATE_SLEW_LIMIT,
    THRUST_LAG_ASYMMETRY,
    BETAFLIGHT_LOOP,
    MOTORS,
    RATE_SCALE,
    YAW_REACTION,
    MOTOR_IMBALANCE,
    RATE_CROSS_COUPLING,
    SECOND_ORDER_RATES,
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
    MOCAP_LATENCY,
)
# Last, what a log has shown beyond all of these.
ORDER = (*EFFECTS, LEARNED_LAW)
ROUNDING = 1e-5  # of float32 times
# Largest delay that is drawn around a model's: this factor times it, plus these seconds.
DRAWN_LONGER, DRAWN_LATER_S = 1.25, 0.02
BY_NAME = {effect.name: effect for effect in ORDER}
_BY_CLASS = {effect.parameters: effect for effect in ORDER}


def with_voltages_times(factor: float, parameters: Any) -> Any:
    """Return the parameters of an effect with those in volts times a factor."""
    volts = [name for name, one in effect_of(parameters).ranges.items() if one.unit == "V"]
    return parameters._replace(**{name: getattr(parameters, name) * factor for name in volts})


def effect_of(parameters: Any) -> Effect:
    """Return the effect that parameters belong to.

    Raises:
        TypeError: not the parameters of an effect.
    """
    effect = _BY_CLASS.get(type(parameters))
    if effect is None:
        names = ", ".join(effect.parameters.__name__ for effect in ORDER)
        raise TypeError(f"effect: found {type(parameters).__name__}, expected one of {names}")
    return effect


def check_parameters(parameters: Any, dt: Any, delay_steps: int = DEFAULT_DELAY_STEPS) -> None:
    """Raise ValueError for concrete values beyond what the effect can do.

    The message names effect and parameter.

    Args:
        dt: step of time, s.
        delay_steps: how many steps are remembered, as in ``start_memories``.
    """
    effect = effect_of(parameters)
    for name, bounds in effect.ranges.items():
        value = np.asarray(getattr(parameters, name))
        max_delay_s = np.inf
        if name in effect.max_steps:  # what the other delays of the effect leave
            other_delays_s = lasting_s(parameters) - np.maximum(value, 0.0)
            max_delay_s = delay_steps * np.asarray(dt, float) - other_delays_s
        high = np.minimum(bounds.high, max_delay_s)
        if not np.all((value >= bounds.low) & (value <= high * (1.0 + ROUNDING))):
            reason = f" at steps of {dt} s" if np.any(max_delay_s < bounds.high) else ""
            expected = f"{bounds.low:g} to {np.min(high):g} {bounds.unit}{reason}"
            raise ValueError(f"{effect.name}.{name}: found {value}, expected {expected}")


def merge(present: Effects, *added: Any) -> Effects:
    """Return parameters of effects in the order of ``ORDER``; added ones replace present ones."""
    by_name = {effect_of(parameters).name: parameters for parameters in (*present, *added)}
    return tuple(by_name[effect.name] for effect in ORDER if effect.name in by_name)


def lasting_s(parameters: Any) -> np.ndarray:
    """Return the sum of the delays of an effect with concrete parameters, s."""
    delays = [getattr(parameters, name) for name in effect_of(parameters).max_steps]
    return np.sum([np.maximum(np.asarray(delay, float), 0.0) for delay in delays], axis=0)


def delay_steps_of(effects: Effects, dt: float) -> int:
    """Return how many steps the delays of a model with concrete parameters need.

    The number leaves room to draw longer delays.
    """
    longest_s = max((float(np.max(lasting_s(parameters))) for parameters in effects), default=0.0)
    needed = np.ceil((DRAWN_LONGER * longest_s + DRAWN_LATER_S) / dt * (1.0 - ROUNDING))
    return int(np.clip(needed, DEFAULT_DELAY_STEPS, MAX_DELAY_STEPS))


def start_memories(
    effects: Effects, drone: Drone, delay_steps: int = DEFAULT_DELAY_STEPS
) -> Memories:
    """Return what the effects of a model remember when an episode begins; None for most.

    Where motors are commanded, an applied action of rates is none of their outputs: what delays
    commands begins as if all motors had always been commanded its thrust.

    Args:
        delay_steps: of delays; every step of an episode carries them, so that fewer are faster.
    """
    commanded = drone
    for parameters in effects:
        if isinstance(parameters, Motors):
            commanded = as_commanded(parameters, drone)

    def start(parameters: Any) -> Any:
        effect = effect_of(parameters)
        if effect.memory is None:
            return None
        begun = drone if effect.takes_motors else commanded
        return effect.memory.start(parameters, begun, *([delay_steps] if effect.max_steps else []))

    return tuple(start(parameters) for parameters in effects)


def at_row(memories: Memories, time_s: Scalar) -> Memories:
    """Return memories of effects at the time of a row of a log, s since the flight began."""
    return tuple(Flight(time_s) if isinstance(memory, Flight) else memory for memory in memories)


def acts(effects: Effects, stage: str) -> bool:
    """Return whether any effect of a model acts at a stage (static)."""
    return any(stage in effect_of(parameters).hooks for parameters in effects)


def takes_motors(effects: Effects) -> bool:
    """Return whether the commands of a model are those of four motors (static)."""
    return any(effect_of(parameters).takes_motors for parameters in effects)


def check_motors(effects: Effects) -> None:
    """Raise ValueError for the effect ``motors`` without a frame, or beside effects of sticks."""
    for parameters in effects:
        if isinstance(parameters, Motors) and not np.all(np.asarray(parameters.front_y) > 0.0):
            raise ValueError(
                f"effects.motors.front_y: found {np.min(parameters.front_y):g}, expected above 0: "
                "without a frame there are no motors to command"
            )
    check_beside_motors(effects)


def check_beside_motors(effects: Effects) -> None:
    """Raise ValueError for effects of sticks beside motors that are commanded.

    Neutral effects and motors without a frame do nothing. Traced values cannot be checked.
    """
    if not any(_commands_motors(parameters) for parameters in effects):
        return
    for parameters in effects:
        effect = effect_of(parameters)
        neutral = effect.parameters()
        for name in stick_fields(effect):
            value, expected = getattr(parameters, name), getattr(neutral, name)
            if not isinstance(value, jax.core.Tracer) and np.any(np.asarray(value) != expected):
                raise ValueError(
                    f"effects.{effect.name}.{name}: found {np.ravel(value)[0]:g}, expected "
                    f"{expected:g}: it acts on sticks, and with the effect motors there are none"
                )


def _commands_motors(parameters: Any) -> bool:
    """Return whether parameters are those of motors with a frame, as far as values are known."""
    if not isinstance(parameters, Motors) or isinstance(parameters.front_y, jax.core.Tracer):
        return False
    return bool(np.any(np.asarray(parameters.front_y) > 0.0))


def stick_fields(effect: Effect) -> tuple[str, ...]:
    """Return the parameters that act on sticks or on the rates that follow them, not on motors.

    A delay of all commands is that of motors, too. A learnt law is what a log of motors showed.
    """
    if effect is COMMAND_DELAY:  # commands of yaw and thrust are two of the motors
        return ("yaw_extra_s", "thrust_extra_s")
    acts_on_sticks = not {"command", "lag", "rates"}.isdisjoint(effect.hooks)
    if effect is BETAFLIGHT_LOOP or (acts_on_sticks and effect is not LEARNED_LAW):
        return tuple(effect.ranges)
    return ()


def fold(
    stage: str,
    effects: Effects,
    memories: Memories,
    value: Any,
    context: Any,
) -> Any:
    """Return a stage's value after all effects of a model that act there, in order."""
    for parameters, memory in zip(effects, memories, strict=True):
        hook = effect_of(parameters).hooks.get(stage)
        if hook is not None:
            value = hook(parameters, memory, value, context)
    return value


def respond(
    effects: Effects, memories: Memories, lagged: Any, context: CommandContext
) -> tuple[Any, Memories]:
    """Return the applied action at the end of a span of the step, and the effects' memories."""
    later = list(memories)
    for index, parameters in enumerate(effects):
        hook = effect_of(parameters).hooks.get("respond")
        if hook is not None:
            lagged, later[index] = hook(parameters, memories[index], lagged, context)
    return lagged, tuple(later)


def fold_rates(
    effects: Effects,
    memories: Memories,
    context: RatesContext,
    first_rates: Rates = (),
) -> Rates:
    """Return the value of the stage rates before each effect, and last, after all of them.

    The first is ``context.first_input_b``.

    Args:
        first_rates: the same at the beginning of the step; empty where that is now.
    """
    rates = [context.first_input_b]
    for index, (parameters, memory) in enumerate(zip(effects, memories, strict=True)):
        first_b = first_rates[index] if first_rates else rates[-1]
        effect_context = context._replace(first_input_b=first_b)
        rates.append(fold("rates", (parameters,), (memory,), rates[-1], effect_context))
    return tuple(rates)


def remember(
    effects: Effects,
    memories: Memories,
    context: StepContext,
    first_rates: Rates,
    rates: Rates,
) -> Memories:
    """Return what the effects of a model remember after a step.

    Args:
        first_rates: as from ``fold_rates``, at the beginning of the step.
        rates: the same at its end.
    """
    later = []
    each = zip(effects, memories, first_rates, rates, strict=False)
    for parameters, memory, first_b, last_b in each:
        memory_kind = effect_of(parameters).memory
        if memory_kind and memory_kind.remember:
            effect_context = context._replace(rate_inputs_b=(first_b, last_b))
            memory = memory_kind.remember(parameters, memory, effect_context)
        later.append(memory)
    return tuple(later)


def observe(
    effects: Effects, memories: Memories, offset_b: Any, dt: Scalar
) -> tuple[Memories, Any]:
    """Update memories by measured body rates; return them and what they do not explain.

    Args:
        offset_b: measured rates minus the model's.
        dt: since the last measurement, s.
    """
    corrected = []
    for parameters, memory in zip(reversed(effects), reversed(memories), strict=True):
        memory_kind = effect_of(parameters).memory
        if memory_kind and memory_kind.observe:
            memory, offset_b = memory_kind.observe(parameters, memory, offset_b, dt)
        corrected.append(memory)
    return tuple(reversed(corrected)), offset_b


__all__ = [
    "BY_NAME",
    "DEFAULT_DELAY_STEPS",
    "EFFECTS",
    "LEARNED_LAW",
    "MAX_DELAY_STEPS",
    "STAGES",
    "AccelerometerBias",
    "AccelerometerScale",
    "ActualRates",
    "BetaflightLoop",
    "BetaflightRates",
    "CommandDelay",
    "Effect",
    "GroundEffect",
    "GyroBias",
    "GyroScale",
    "ImuLatency",
    "ImuOffset",
    "LearnedLaw",
    "LinearDrag",
    "MocapLatency",
    "MotorImbalance",
    "Motors",
    "Pose",
    "QuadraticDrag",
    "QuickRates",
    "Range",
    "RateCrossCoupling",
    "RateExpo",
    "RateSaturation",
    "RateScale",
    "RateSlewLimit",
    "RotorDrag",
    "SecondOrderRates",
    "ThrustLagAsymmetry",
    "ThrustScale",
    "ThrustTilt",
    "TranslationalLift",
    "VoltageSag",
    "Wind",
    "YawReaction",
    "acts",
    "at_row",
    "check_beside_motors",
    "check_motors",
    "check_parameters",
    "delay_steps_of",
    "effect_of",
    "fold",
    "fold_rates",
    "merge",
    "observe",
    "remember",
    "respond",
    "start_memories",
    "stick_fields",
    "takes_motors",
]
