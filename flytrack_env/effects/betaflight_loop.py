"""Betaflight's rate loop with mixer and four motors: how sticks become body rates and thrust."""

from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.effects.base import CommandContext, Effect, Memory, Range, Search
from flytrack_env.fusion import one_kernel
from flytrack_env.motors import QUARTER, SIGNS, moment, reached
from flytrack_env.quaternion import Scalar, Vec3
from flytrack_env.state import Action, Drone
from flytrack_env.thrust import collective_thrust

Array = Any  # of the axes, (3,), or the motors, (4,)
NUM_SUBSTEPS = 10  # of a step: 1 ms at 100 Hz
IS_YAW = np.array([False, False, True])
PER_DEGREE = np.pi / 180.0
# Units of the firmware's settings, over the thousand that one unit of the mixer has (pid.h); deg/s.
P_SCALE, I_SCALE, D_SCALE, F_SCALE = 0.032029e-3, 0.244381e-3, 0.000529e-3, 0.013754e-5
I_FACTORS = np.array([1.0, 1.0, 2.5])
PERCENT = 100.0
SUM_LIMITS, I_SHARE = np.array([0.5, 0.5, 0.4]), 0.8  # pidsum_limit, pidsum_limit_yaw; iterm_windup
RELAX_DEG_S = 40.0  # a setpoint that changes so fast stops the integral
FILTER_EXPO = 0.5  # of the cutoffs that follow throttle
D_MAX_HZ, D_BOOST_HZ = 85.0, 35.0
D_MAX_SCALE, D_MAX_ADVANCE = 37.0 * 0.00008 / 35.0, 0.2  # d_max_gain, d_max_advance
ANTI_GRAVITY_HZ, ANTI_GRAVITY_I, ANTI_GRAVITY_P = 5.0, 0.34e-3, 0.0034
ANTI_GRAVITY_DEG_S = 50.0  # of the setpoint, above which P is boosted less
BOOST_SCALE, BOOST_HZ = 0.1, 15.0  # throttle_boost_cutoff
STICK_US, JITTER = 500.0, 7.0  # feedforward_jitter_factor
FF_RATE_LIMIT, NEAR_FULL = 90.0, 0.9  # feedforward_max_rate_limit
YAW_HOLD, YAW_HOLD_S = 15.0, 0.1
MIN_STICK_CHANGE = 1e-5  # of a stick, between two frames
NONE_HZ = 1e5  # a filter that does nothing in a millisecond


class BetaflightLoop(NamedTuple):
    """The craft, and its settings as the firmware's command line has them.

    Without arms there is no loop.

    Attributes:
        roll_arm, pitch_arm, yaw_arm: angular acceleration for a newton of one motor, 1/(kg m).
        yaw_spin: change of the yaw rate when one motor starts, rad/s.
        motor_s: lag of the motors.
        precession: (I_z - I_y) / I_x.
        rear_right, front_right, rear_left, front_left: thrust of a motor as a share of what it
            should be.
        center_x, center_y: where the centre of mass is ahead and left of the motors' middle, as a
            share of the motors' own distance from it.
        gyro_late_s: lag of the gyro beyond that of its filters' settings.
        sticks_hz, throttle_hz: cutoffs of the receiver's smoothing; 0 is no filter.
    """

    roll_arm: Scalar = 0.0
    pitch_arm: Scalar = 0.0
    yaw_arm: Scalar = 0.0
    yaw_spin: Scalar = 0.0
    motor_s: Scalar = 0.02
    precession: Scalar = 0.0
    rear_right: Scalar = 1.0
    front_right: Scalar = 1.0
    rear_left: Scalar = 1.0
    front_left: Scalar = 1.0
    center_x: Scalar = 0.0
    center_y: Scalar = 0.0
    gyro_late_s: Scalar = 0.0
    p_roll: Scalar = 45.0
    p_pitch: Scalar = 47.0
    p_yaw: Scalar = 45.0
    i_roll: Scalar = 80.0
    i_pitch: Scalar = 84.0
    i_yaw: Scalar = 80.0
    d_roll: Scalar = 30.0
    d_pitch: Scalar = 34.0
    d_yaw: Scalar = 0.0
    d_max_roll: Scalar = 40.0
    d_max_pitch: Scalar = 46.0
    d_max_yaw: Scalar = 0.0
    f_roll: Scalar = 120.0
    f_pitch: Scalar = 125.0
    f_yaw: Scalar = 120.0
    sticks_hz: Scalar = 37.0
    throttle_hz: Scalar = 37.0
    gyro_lpf1_dyn_min_hz: Scalar = 250.0
    gyro_lpf1_dyn_max_hz: Scalar = 500.0
    gyro_lpf2_static_hz: Scalar = 500.0
    dterm_lpf1_dyn_min_hz: Scalar = 75.0
    dterm_lpf1_dyn_max_hz: Scalar = 150.0
    dterm_lpf2_static_hz: Scalar = 150.0
    yaw_lowpass_hz: Scalar = 100.0
    iterm_relax_cutoff: Scalar = 15.0
    tpa_rate: Scalar = 65.0
    tpa_breakpoint: Scalar = 1350.0
    anti_gravity_gain: Scalar = 80.0
    throttle_boost: Scalar = 5.0
    feedforward_smooth_factor: Scalar = 25.0
    feedforward_boost: Scalar = 15.0
    thrust_linear: Scalar = 0.0
    motor_idle: Scalar = 550.0

    def axes(self, name: str) -> Array:
        """Return a setting of roll, pitch and yaw, (3,)."""
        return jnp.stack([getattr(self, f"{name}_{axis}") for axis in ("roll", "pitch", "yaw")])

    @property
    def arms(self) -> Array:
        """The arms of the axes, (3,)."""
        return jnp.stack([self.roll_arm, self.pitch_arm, self.yaw_arm])

    @property
    def health(self) -> Array:
        """Of the motors, (4,)."""
        return jnp.stack([self.rear_right, self.front_right, self.rear_left, self.front_left])

    @property
    def idle(self) -> Scalar:
        """The least command of a motor, as a share of full."""
        return self.motor_idle / PERCENT / PERCENT


class Frames(NamedTuple):
    """The receiver's last frame, and the feedforward's memory of earlier frames; (3,) each.

    Attributes:
        setpoint, hold: deg/s, the latter follows slowly.
        speed: smoothed, deg/s^2.
        speed_change: of it, in a frame.
        moved: by how much the stick did, us.
        was_still: 1 if it did not.
    """

    stick: Array
    setpoint: Array
    speed: Array
    speed_change: Array
    moved: Array
    was_still: Array
    hold: Array
    feedforward: Array


class Axes(NamedTuple):
    """Filters, a tuple where of several stages, and integrals; (3,) each, deg/s or mixer units."""

    setpoint: tuple[Array, ...]
    feedforward: tuple[Array, ...]
    gyro: Array
    dterm: tuple[Array, ...]
    d_range: tuple[Array, ...]
    d_boost: tuple[Array, ...]
    relax: Array
    p: Array
    integral: Array


class Throttle(NamedTuple):
    """Filters of the throttle, 0 to 1.

    They are its smoothing, last value, speed (for anti-gravity) and slow part.
    """

    smooth: tuple[Scalar, ...]
    last: Scalar
    speed: tuple[Scalar, ...]
    slow: Scalar


class Loop(NamedTuple):
    """What the loop remembers; motors: (4,) speeds as shares of that at full command.

    Axes and motors are arrays, since a loop for each of them is three times as long to compile.
    """

    frames: Frames
    axes: Axes
    throttle: Throttle
    motors: Array


class Turn(NamedTuple):
    """What a substep moves: body rates, (3,) deg/s, and what the loop remembers but for frames."""

    rates: Array
    axes: Axes
    throttle: Throttle
    motors: Array


class SubstepInputs(NamedTuple):
    """What the substeps under one frame share.

    Attributes:
        setpoint, feedforward: of the frame, (3,) each.
        throttle: 0 to 1.
        thrust_coeffs, battery_v: of the thrust map.
        dt: of a substep, s.
    """

    loop: BetaflightLoop
    setpoint: Array
    feedforward: Array
    throttle: Scalar
    thrust_coeffs: tuple[Scalar, ...]
    battery_v: Scalar
    dt: Scalar


def start(loop: BetaflightLoop, drone: Drone) -> Loop:
    """Return the memory of an episode that begins: all has settled where the drone is."""
    rates = jnp.stack(drone.rates_b) / PER_DEGREE
    zero, sticks = jnp.zeros_like(rates), jnp.stack(drone.applied[:3])
    frames = Frames(sticks, rates, zero, zero, zero, zero + 1.0, rates, zero)
    axes = Axes(
        (rates,) * 3,
        (zero,) * 3,
        rates,
        (rates,) * 2,
        (zero,) * 2,
        (zero + 1.0,) * 2,
        rates,
        zero,
        zero,
    )
    level = 0.5 * (drone.applied.thrust + 1.0)
    throttle = Throttle((level,) * 3, level, (jnp.zeros_like(level),) * 2, level)
    motors = jnp.broadcast_to(loop.idle + (1.0 - loop.idle) * level, (4,))
    return Loop(frames, axes, throttle, motors)


def _action_of(share: Scalar, loop: BetaflightLoop) -> Scalar:
    """Return the thrust action at which motors of this speed are steady."""
    return 2.0 * (share - loop.idle) / (1.0 - loop.idle) - 1.0


def _like(constants: np.ndarray, value: Array) -> Array:
    """Return constants in a value's precision, since a compiled kernel keeps that of its trace."""
    return jnp.asarray(constants, value.dtype)


def _lowpass(
    stages: tuple[Scalar, ...], target: Scalar, cutoff_hz: Scalar, dt: Scalar
) -> tuple[Scalar, ...]:
    """Return the stages of a low pass after a held target, exactly.

    Args:
        cutoff_hz: of all stages together.
    """
    correction = 1.0 / (2.0 ** (1.0 / len(stages)) - 1.0) ** 0.5
    cutoff_hz = jnp.where(cutoff_hz > 0.0, cutoff_hz * correction, NONE_HZ)
    turns = 2.0 * jnp.pi * cutoff_hz * dt
    fade, filtered = jnp.exp(-turns), []
    offsets = [stage - target for stage in stages]
    for index in range(len(stages)):
        share: Scalar = 1.0
        remainder: Scalar = 0.0
        for back in range(index + 1):
            remainder = remainder + share * offsets[index - back]
            share = share * turns / (back + 1)
        filtered.append(target + fade * remainder)
    return tuple(filtered)


def _received(
    loop: BetaflightLoop, frames: Frames, stick: Array, full: Array, dt: Scalar
) -> Frames:
    """Return the frames after a new one.

    Args:
        full: rates at full stick, (3,) deg/s.
        dt: since the last frame, s.
    """
    setpoint, reach = stick * full, jnp.abs(full)
    change = setpoint - frames.setpoint
    is_still = jnp.abs(stick - frames.stick) < MIN_STICK_CHANGE
    is_inside = jnp.abs(setpoint) < NEAR_FULL * reach
    was_still = frames.was_still > 0.5
    # A frame that repeats the last one is taken for a lost one, unless the one before did, too.
    guessed = jnp.where(is_inside & ~was_still, frames.speed + frames.speed_change, 0.0)
    speed = jnp.where(is_still, guessed, change / dt / jnp.where(was_still, 2.0, 1.0))
    moved = STICK_US * jnp.abs(stick - frames.stick)
    moved = jnp.where(is_still & is_inside & ~was_still, frames.moved, moved)
    before = jnp.where(is_still & was_still, 0.0, frames.speed)
    keep = 1.0 - loop.feedforward_smooth_factor / PERCENT
    speed = before + keep * (speed - before)
    speed_change = frames.speed_change + keep * (speed - before - frames.speed_change)
    attenuation = jnp.minimum((0.5 * (moved + frames.moved) + 1.0) / (1.0 + JITTER), 1.0)
    hold = frames.hold + dt / (dt + YAW_HOLD_S) * (setpoint - frames.hold)
    boosted = (speed + speed_change / dt * loop.feedforward_boost * 1e-3) * attenuation
    limit = jnp.maximum(reach - jnp.abs(setpoint), 0.0) * FF_RATE_LIMIT
    boosted = jnp.where(boosted * setpoint > 0.0, jnp.clip(boosted, -limit, limit), boosted)
    feedforward = jnp.where(IS_YAW, speed * attenuation + YAW_HOLD * (setpoint - hold), boosted)
    return Frames(
        stick, setpoint, speed, speed_change, moved, is_still.astype(hold.dtype), hold, feedforward
    )


def _throttled(
    loop: BetaflightLoop, throttle: Throttle, stick: Scalar, dt: Scalar
) -> tuple[Throttle, Scalar, Scalar]:
    """Return the throttle's filters a substep later, the throttle, and its boost of the loop."""
    level = _lowpass(throttle.smooth, stick, loop.throttle_hz, 0.5 * dt)[-1]
    headroom = 1.0 - level
    speed = jnp.abs(level - throttle.last) / dt * headroom * headroom
    speed = jnp.where(level > throttle.last, 0.5 * speed * headroom, speed)
    boost = loop.anti_gravity_gain * throttle.speed[-1]
    later = Throttle(
        _lowpass(throttle.smooth, stick, loop.throttle_hz, dt),
        level,
        _lowpass(throttle.speed, speed, ANTI_GRAVITY_HZ, dt),
        _lowpass((throttle.slow,), level, BOOST_HZ, dt)[0],
    )
    return later, level, boost


def _cutoff(low: Scalar, high: Scalar, level: Scalar) -> Scalar:
    """Return the cutoff, Hz, of a filter that follows throttle."""
    return low + (high - low) * level * (1.0 + FILTER_EXPO * (1.0 - level))


def _filtered_gyro(
    loop: BetaflightLoop, gyro: Array, rates: Array, level: Scalar, dt: Scalar
) -> Array:
    """Return the gyro behind both filters, as one lag.

    The lag is shorter by half a substep, the delay that the substep itself has.
    """

    def lag_s(cutoff_hz: Scalar) -> Scalar:
        return 1.0 / (2.0 * jnp.pi * jnp.where(cutoff_hz > 0.0, cutoff_hz, NONE_HZ))

    first = lag_s(_cutoff(loop.gyro_lpf1_dyn_min_hz, loop.gyro_lpf1_dyn_max_hz, level))
    lag = first + lag_s(loop.gyro_lpf2_static_hz) + loop.gyro_late_s - 0.5 * dt
    lag = jnp.maximum(lag, lag_s(NONE_HZ))
    return gyro + (1.0 - jnp.exp(-dt / lag)) * (rates - gyro)


def _damped(
    loop: BetaflightLoop, axes: Axes, gyro: Array, feedforward: Array, level: Scalar, dt: Scalar
) -> tuple[Array, tuple[Any, Any, Any]]:
    """Return the D term, and its filters afterwards: ``dterm``, ``d_range`` and ``d_boost``.

    The term is that of the gyro behind two filters, larger where the craft or a stick jerks.
    """
    d, d_max = loop.axes("d"), loop.axes("d_max")
    cutoff_hz = _cutoff(loop.dterm_lpf1_dyn_min_hz, loop.dterm_lpf1_dyn_max_hz, level)
    first = _lowpass(axes.dterm[:1], gyro, cutoff_hz, dt)[0]
    second = _lowpass(axes.dterm[1:], first, loop.dterm_lpf2_static_hz, dt)[0]
    slope = (axes.dterm[1] - second) / dt
    max_gain = jnp.maximum(d_max / jnp.where(d > 0.0, d, jnp.inf), 1.0)
    d_range = _lowpass(axes.d_range, slope, D_MAX_HZ, dt)
    jerk = jnp.maximum(jnp.abs(d_range[-1]), D_MAX_ADVANCE * jnp.abs(feedforward))
    d_boost = _lowpass(axes.d_boost, 1.0 + (max_gain - 1.0) * D_MAX_SCALE * jerk, D_BOOST_HZ, dt)
    breakpoint = (loop.tpa_breakpoint - 1e3) * 1e-3
    attenuation = (
        loop.tpa_rate / PERCENT / (1.0 - breakpoint) * jnp.maximum(level - breakpoint, 0.0)
    )
    term = D_SCALE * d * slope * jnp.minimum(d_boost[-1], max_gain) * (1.0 - attenuation)
    return term, ((first, second), d_range, d_boost)


def _controlled(
    state: Turn, inputs: SubstepInputs, level: Scalar, boost: Scalar
) -> tuple[Axes, Array]:
    """Return the axes a substep later, and what they ask of the mixer, (3,)."""
    axes, loop, dt = state.axes, inputs.loop, inputs.dt
    limits, factors = _like(SUM_LIMITS, state.rates), _like(I_FACTORS, state.rates)
    setpoint = _lowpass(axes.setpoint, inputs.setpoint, loop.sticks_hz, 0.5 * dt)[-1]
    feedforward = _lowpass(axes.feedforward, inputs.feedforward, loop.sticks_hz, 0.5 * dt)[-1]
    gyro = _filtered_gyro(loop, axes.gyro, state.rates, level, dt)
    error = setpoint - gyro
    damping, filters = _damped(loop, axes, gyro, feedforward, level, dt)
    # The integral halts while the setpoint changes fast, and grows faster while the throttle does.
    relax = _lowpass((axes.relax,), setpoint, loop.iterm_relax_cutoff, dt)[0]
    halted = jnp.where(IS_YAW, 1.0, jnp.maximum(1.0 - jnp.abs(setpoint - relax) / RELAX_DEG_S, 0.0))
    axis_boost = jnp.where(IS_YAW, 0.0, boost)
    gain = (I_SCALE * factors * loop.axes("i") + ANTI_GRAVITY_I * axis_boost) * halted
    max_integral = I_SHARE * limits
    integral = jnp.clip(axes.integral + gain * error * dt, -max_integral, max_integral)
    p_hz = jnp.where(IS_YAW, loop.yaw_lowpass_hz, NONE_HZ)
    p_term = _lowpass((axes.p,), P_SCALE * loop.axes("p") * error, p_hz, dt)[0]
    calm = jnp.maximum(jnp.abs(setpoint) / ANTI_GRAVITY_DEG_S, 1.0)
    demand = p_term * (1.0 + ANTI_GRAVITY_P * axis_boost / calm) + integral + damping
    demand = jnp.clip(demand + F_SCALE * loop.axes("f") * feedforward, -limits, limits)
    later = Axes(
        _lowpass(axes.setpoint, inputs.setpoint, loop.sticks_hz, dt),
        _lowpass(axes.feedforward, inputs.feedforward, loop.sticks_hz, dt),
        gyro,
        *filters,
        relax,
        p_term,
        integral,
    )
    return later, demand


def _mixed(loop: BetaflightLoop, demand: Array, throttle: Throttle, level: Scalar) -> Array:
    """Return the motors' commands, (4,) shares of full; the axes come before the throttle."""
    boost = loop.throttle_boost * BOOST_SCALE
    level = jnp.clip(level + boost * (level - throttle.slow), 0.0, 1.0)
    linear = loop.thrust_linear / PERCENT
    level = level / (1.0 + (linear - 0.5 * linear * linear) * (1.0 - level) ** 2)
    mix = sum(
        axis_demand * signs for axis_demand, signs in zip(demand, _like(SIGNS, demand), strict=True)
    )
    zero = jnp.zeros_like(level)
    high, low = reduce(jnp.maximum, mix, zero), reduce(jnp.minimum, mix, zero)
    scale = 1.0 / jnp.maximum(high - low, 1.0)
    outputs = jnp.clip(level, -low * scale, 1.0 - high * scale) + scale * mix
    linearized = outputs * (1.0 + linear * (1.0 - outputs) ** 2)
    return loop.idle + (1.0 - loop.idle) * jnp.clip(linearized, 0.0, 1.0)


def _turned(state: Turn, inputs: SubstepInputs, motors: Array) -> Array:
    """Return the body rates a substep later, deg/s, at whose end motors are as fast as given."""
    loop, both, signs = inputs.loop, (motors, state.motors), _like(SIGNS, motors)
    thrusts = sum(
        collective_thrust(_action_of(speeds, loop), inputs.battery_v, inputs.thrust_coeffs)
        for speeds in both
    )
    thrusts = 0.5 * QUARTER * loop.health * thrusts  # of a motor, the mean of the substep
    levers = jnp.stack([-loop.center_y, loop.center_x, jnp.zeros_like(loop.center_x)])
    torques = moment(thrusts, [signs[:, motor] + levers for motor in range(4)])
    spun = loop.yaw_spin * moment(both[0] - both[1], signs[2])
    x, y, z = state.rates
    # The midpoint rule turns roll and pitch by an angle; Euler's would feed a fast yaw until it
    # overflows.
    half = 0.5 * inputs.dt * loop.precession * PER_DEGREE * z
    turned = jnp.stack([x - half * (2.0 * y + half * x), y + half * (2.0 * x - half * y)]) / (
        1.0 + half * half
    )
    rates = jnp.concatenate([turned, z[None]])
    change = inputs.dt * loop.arms * torques + jnp.where(IS_YAW, spun, 0.0)
    return rates + change / PER_DEGREE


def _substep(state: Turn, inputs: SubstepInputs) -> Turn:
    """Return the state a substep later under the same frames."""
    loop, dt = inputs.loop, inputs.dt
    throttle, level, boost = _throttled(loop, state.throttle, inputs.throttle, dt)
    axes, demand = _controlled(state, inputs, level, boost)
    commands = _mixed(loop, demand, throttle, level)
    motors = state.motors + reached(loop.motor_s, dt) * (commands - state.motors)
    return Turn(_turned(state, inputs, motors), axes, throttle, motors)


def _respond(
    loop: BetaflightLoop, memory: Loop, lagged: Action, context: CommandContext
) -> tuple[Action, Loop]:
    """Return the applied action and the memory at the end of a span in which a command acts."""
    begin, end = context.span
    num_substeps = round(NUM_SUBSTEPS * (end - begin))
    full, acting, frames = (
        jnp.stack(context.full_stick_b) / PER_DEGREE,
        context.command,
        memory.frames,
    )
    if begin == 0.0:  # a frame of the receiver comes with the step
        frames = _received(loop, frames, jnp.stack(acting[:3]), full, context.dt)
    inputs = SubstepInputs(
        loop,
        frames.setpoint,
        frames.feedforward,
        0.5 * (acting.thrust + 1.0),
        tuple(context.thrust_coeffs[index] for index in range(6)),
        context.drone.battery_v,
        context.dt / NUM_SUBSTEPS,
    )

    @one_kernel
    def substeps(state: Turn, inputs: SubstepInputs) -> Turn:
        return jax.lax.fori_loop(0, num_substeps, lambda _, state: _substep(state, inputs), state)

    rates = full * jnp.stack(context.drone.applied[:3])
    moved = substeps(Turn(rates, *memory[1:]), inputs)
    sticks = moved.rates / jnp.where(full, full, 1.0)
    share = jnp.sqrt(sum(loop.health * moved.motors**2) / 4.0)
    response = Action(sticks[0], sticks[1], sticks[2], _action_of(share, loop))
    is_there = (loop.roll_arm > 0.0) & (loop.pitch_arm > 0.0)
    applied = Action(*(jnp.where(is_there, *pair) for pair in zip(response, lagged, strict=True)))
    return applied, Loop(frames, *moved[1:])


def observe(loop: BetaflightLoop, memory: Loop, offset_b: Vec3, dt: Scalar) -> tuple[Loop, Vec3]:
    """Return the memory with gyro filters moved to the measured rates, and the rates' offset."""
    step, axes = jnp.stack(offset_b) / PER_DEGREE, memory.axes
    axes = axes._replace(gyro=axes.gyro + step, dterm=tuple(stage + step for stage in axes.dterm))
    return memory._replace(axes=axes), offset_b


CRAFT, MOTORS = BetaflightLoop._fields[:6], BetaflightLoop._fields[6:10]
SETTINGS = BetaflightLoop._fields[BetaflightLoop._fields.index("p_roll") :]
CENTER, GAINS, LATE = (
    ("center_x", "center_y"),
    ("p_roll", "p_pitch", "d_roll", "d_pitch"),
    "gyro_late_s",
)
NOTABLE = {
    **dict.fromkeys(CRAFT[:2], 5.0),
    **dict.fromkeys(MOTORS, 0.05),
    **dict.fromkeys(CENTER, 0.02),
    **dict.fromkeys(GAINS, 8.0),
    LATE: 0.001,
}
CUTOFF, GAIN, ARM = Range(0.0, 4000.0, "Hz"), Range(0.0, 250.0, "1"), Range(0.0, 1e4, "1/(kg m)")
BETAFLIGHT_LOOP = Effect(
    name="betaflight_loop",
    parameters=BetaflightLoop,
    ranges={
        **dict.fromkeys(CRAFT[:3], ARM),
        "yaw_spin": Range(-100.0, 100.0, "rad/s"),
        "motor_s": Range(0.001, 0.2, "s"),
        "precession": Range(-1.0, 1.0, "1"),
        **dict.fromkeys(MOTORS, Range(0.0, 1.5, "1")),
        **dict.fromkeys(CENTER, Range(-0.8, 0.8, "1")),
        LATE: Range(-0.01, 0.03, "s"),
        **dict.fromkeys(SETTINGS[:15], GAIN),
        **dict.fromkeys(SETTINGS[15:25], CUTOFF),
        "tpa_rate": Range(0.0, 100.0, "%"),
        "tpa_breakpoint": Range(1000.0, 1990.0, "us"),
        "anti_gravity_gain": GAIN,
        "throttle_boost": Range(0.0, 100.0, "%"),
        "feedforward_smooth_factor": Range(0.0, 95.0, "%"),
        "feedforward_boost": Range(0.0, 50.0, "1"),
        "thrust_linear": Range(0.0, 150.0, "%"),
        "motor_idle": Range(0.0, 2000.0, "%/100"),
    },
    notable=NOTABLE,
    equation=r"c = \text{mix}\left(u_t, P e + I \int e\, dt "
    r"- D \dot{\omega} + F \dot{u}\right), \quad "
    r"\text{motor}\, \dot{s}_k + s_k = c_k, \quad "
    r"\dot{\omega}_i = \text{arm}_i \sum_k \pm \tfrac{1}{4} T(s_k, V)",
    source="pidController and mixTable of Betaflight 4.6 with legacy mixer, airmode and PT1 "
    "filters (src/main/flight/pid.c, mixer.c, src/main/fc/rc.c), a frame of the receiver at each "
    "step, and motors that each give a quarter of the thrust curve",
    hooks={"respond": _respond},
    memory=Memory(start=start, observe=observe),
    search=Search(
        shapes=tuple(name for name in BetaflightLoop._fields if name not in NOTABLE),
        groups=(
            GAINS,
            (LATE,),
            CENTER,
            *((motor,) for motor in MOTORS),
            MOTORS[:2],
            MOTORS[::2],
            MOTORS[::3],
        ),
        is_setting=True,
        fitted=CRAFT,
    ),
)
