"""Commands from attitude or torque setpoints or motor outputs, where a log has no rate setpoints.

An attitude controller commands rates in proportion to the attitude error, so the rate command is
that error times the gain. A rate controller commands a torque in proportion to the rate error, so
the rate command is the measured rate plus the torque over the gain. Gains are stated in the
mapping, or identified from the log.
"""

from collections.abc import Mapping as Channels
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.effects import Motors
from flytrack_env.motors import NAMES
from flytrack_sysid.importing.flight import saturation
from flytrack_sysid.importing.units import PER_DEGREE
from flytrack_sysid.kinematics import low_pass
from flytrack_sysid.log import LogError
from flytrack_sysid.log_table import COMMAND_MARGIN
from flytrack_sysid.plausibility import MIN_ROWS
from flytrack_sysid.resample import SLOW_STEP_S
from flytrack_sysid.timestamps import MAX_GAP_S

AXES = ("roll", "pitch", "yaw")
FLYING_THRUST = -0.9  # command: below, it may stand on the ground, where rates do not follow
# Candidate lags and delays, s, of the rate loop while an attitude gain is identified.
LAGS_S, DELAYS_S = (0.0, 0.02, 0.04, 0.06, 0.1, 0.15), (0.0, 0.01, 0.02, 0.03, 0.04)
MIN_CORRELATION = 0.7  # of the rates with those of an identified attitude gain
LEFT_OUT = "the controller's sticks are left out"
MIN_EXPLAINED = 0.9  # of the torques' variance: a controller computes torques without noise


class CommandRules(NamedTuple):
    """How commands follow from setpoints of attitude or torque, and from motors.

    Attributes:
        attitude_gain: of roll, pitch, yaw (rad/s per rad); 0 to identify one.
        rate_gain: of roll, pitch, yaw (N m per rad/s); None to identify it.
        motors_as_thrust: the mean of the motors replaces the thrust command.
        motors_as_command: the outputs of four motors are the commands.
        motor_torque: about x, y, z by each motor at its upper end, (3, num_motors) N m; None where
            torques are logged or unknown.
    """

    attitude_gain: tuple[float, ...] = (0.0, 0.0, 0.0)
    rate_gain: tuple[float, ...] | None = None
    motors_as_thrust: bool = False
    motors_as_command: bool = False
    motor_torque: tuple[tuple[float, ...], ...] | None = None


def read_commands(
    source: str,
    time: np.ndarray,
    channels: Channels[str, np.ndarray],
    rules: CommandRules,
    max_rate_deg_s: tuple[float, ...] | None,
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return a flight's commands, (num_rows, 4) in [-1, 1], and notes on assumptions and clipping.

    Args:
        source: the log, for messages.
        time: (num_rows,) s.
        channels: of ``CHANNELS``, and ``attitude_command`` (roll, pitch, yaw, rad),
            ``own_attitude`` (the autopilot's estimate, rad), ``torque_command`` (N m),
            ``reference_rates`` (rad/s), ``thrust_command`` (-1 to 1) and ``motors`` (0 to 1),
            (num_rows, n) each.
        rules: how commands follow from these channels.
        max_rate_deg_s: rates of roll, pitch, yaw at a command of 1; None if unknown.

    Raises:
        LogError: something is missing or cannot be identified.
    """
    notes: tuple[str, ...] = ()
    if "motors" in channels:
        notes += (f"{source}: {saturation(channels['motors'].max(axis=1) >= 1.0)}",)
    if rules.motors_as_command:
        return commands_of_motors(source, channels.get("motors")), notes
    thrust, new_notes = _thrust(source, channels, rules)
    notes += new_notes
    if "u" in channels:
        commands = np.column_stack([channels["u"][:, :3], thrust])
    else:
        if max_rate_deg_s is None:
            raise LogError(
                f"{source}: craft.max_rate_deg_s: missing in the mapping: which rates are a "
                "command of 1?"
            )
        rates, new_notes = _rates(
            source, time, {**channels, "thrust_command": thrust[:, None]}, rules
        )
        commands = np.column_stack([rates / (np.array(max_rate_deg_s) * PER_DEGREE), thrust])
        notes += new_notes
    is_past = np.any(np.abs(commands) > 1.0 + COMMAND_MARGIN, axis=1)
    if is_past.any():
        notes += (
            f"{source}: commands clipped to [-1, 1] in {is_past.sum()} of {len(is_past)} rows",
        )
    return np.clip(commands, -1.0, 1.0), notes


def read_sticks(
    source: str,
    channels: Channels[str, np.ndarray],
    max_rate_deg_s: tuple[float, ...] | None,
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Return the rate setpoints that a log holds beside motors that are the commands, and a note.

    Setpoints that follow from attitudes or torques are none: they would have the rates of the
    motors in them.

    Args:
        source: the log, for messages.
        channels: as for ``read_commands``.
        max_rate_deg_s: rates of roll, pitch, yaw at a command of 1; None if unknown.

    Returns:
        sticks: (num_rows, 4) in [-1, 1]; None where the log does not hold them or their scale.
        notes: for the user.
    """
    if "u" not in channels:
        return None, ()
    if max_rate_deg_s is None:
        return None, (f"{source}: {LEFT_OUT}: craft.max_rate_deg_s: missing in the mapping",)
    return np.clip(channels["u"], -1.0, 1.0), ()


def commands_of_motors(source: str, motors: np.ndarray | None) -> np.ndarray:
    """Return the outputs of four motors, 0 to 1, as commands, (num_rows, 4) in [-1, 1].

    Raises:
        LogError: another number of motors, or a motor that stands still while others move.
    """
    where = f"{source}: motors.as_command"
    if motors is None:
        raise LogError(f"{where}: found no motor outputs in the log or mapping")
    if motors.shape[1] != len(NAMES):
        found = f"found {motors.shape[1]} motors"
        raise LogError(f"{where}: {found}, expected the 4 of a quadcopter: {', '.join(NAMES)}")
    spans = np.ptp(motors, axis=0)
    for name, span, first in zip(NAMES, spans, motors[0], strict=True):
        if span == 0.0 < spans.max():
            raise LogError(
                f"{where}: motor {name}: found {first:.4g} of its range in every row while others "
                "move, expected the output of a motor in flight"
            )
    return 2.0 * motors - 1.0


def check_motors_of_autopilot(
    source: str, steps_s: np.ndarray, motors: Motors | None, turns_out: bool
) -> None:
    """Check an autopilot's own log of motors against what a model of motors needs.

    Args:
        source: log and message, for the error.
        steps_s: between its samples.
        motors: the frame that the mapping states; None if it does not.
        turns_out: whether the autopilot's propellers turn the other way than Betaflight's default.

    Raises:
        LogError: outputs are too slow, or the mapping's propellers turn the other way.
    """
    step_s = float(np.median(steps_s)) if len(steps_s) else np.inf
    if step_s > SLOW_STEP_S:
        raise LogError(
            f"{source}: found motors at {1.0 / step_s:.3g} Hz, expected {1.0 / SLOW_STEP_S:.0f} Hz "
            "or more with motors.as_command: they answer faster; log them at a higher rate"
        )
    if motors is not None and (float(motors.yaw_arm) < 0.0) != turns_out:
        found, expected = ("in", "out") if turns_out else ("out", "in")
        raise LogError(
            f'{source}: frame.propellers: found "{found}" in the mapping, expected "{expected}" as '
            "the log's parameters say"
        )


def _thrust(
    source: str, channels: Channels[str, np.ndarray], rules: CommandRules
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the thrust commands, (num_rows,), and notes."""
    if rules.motors_as_thrust:
        if "motors" not in channels:
            raise LogError(
                f"{source}: motors.as_thrust: found no motor outputs in the log or mapping"
            )
        return 2.0 * channels["motors"].mean(axis=1) - 1.0, (
            f"{source}: thrust command: the mean of the motors",
        )
    for name, column in (("thrust_command", 0), ("u", 3)):
        if name in channels:
            return channels[name][:, column], ()
    raise LogError(
        f"{source}: thrust_command: missing in the mapping; motors.as_thrust = true can replace it"
    )


def _rates(
    source: str, time: np.ndarray, channels: Channels[str, np.ndarray], rules: CommandRules
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the rate commands, (num_rows, 3) rad/s, and a note on the assumption."""
    if rules.motor_torque is not None and "motors" in channels:
        channels = {
            **channels,
            "torque_command": channels["motors"] @ np.array(rules.motor_torque).T,
        }
    if "torque_command" in channels:
        _check_there(source, channels, "w")
        if rules.rate_gain is None:
            return _rates_of_the_law(source, time, channels)
        assumed = "measured rates, and the torque setpoints over the gain of the rate loop"
        note = f"{source}: rate commands: {assumed}, {_listed(rules.rate_gain)} N m s/rad (given)"
        return channels["w"] + channels["torque_command"] / np.array(rules.rate_gain), (note,)
    if "attitude_command" not in channels:
        raise LogError(f"{source}: found neither rate, attitude nor torque commands in the mapping")
    errors = _attitude_errors(source, channels)
    gains, origin = rules.attitude_gain, "given"
    if min(gains) == 0.0:
        gains, origin = _identified_attitude_gain(source, time, channels, errors, gains)
    note = (
        f"{source}: rate commands: errors of the attitude, times gains of {_listed(gains)} 1/s "
        f"({origin})"
    )
    note += "; what else the attitude controller adds is left out"
    return errors * np.array(gains), (note,)


def _check_there(source: str, channels: Channels[str, np.ndarray], *names: str) -> None:
    for name in names:
        if name not in channels:
            raise LogError(
                f"{source}: {name}: not in the log or its mapping, and rate commands need it"
            )


def _listed(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


def _attitude_errors(source: str, channels: Channels[str, np.ndarray]) -> np.ndarray:
    """Return the setpoints minus the attitude, as Euler angles, (num_rows, 3) rad.

    Common autopilots define the error like this.
    """
    attitude = channels.get("own_attitude")
    if attitude is None:
        _check_there(source, channels, "q")
        attitude = Rotation.from_quat(channels["q"], scalar_first=True).as_euler("ZYX")[:, ::-1]
    errors = channels["attitude_command"] - attitude
    return np.mod(errors + np.pi, 2.0 * np.pi) - np.pi


def _identified_attitude_gain(
    source: str,
    time: np.ndarray,
    channels: Channels[str, np.ndarray],
    errors: np.ndarray,
    given: tuple[float, ...],
) -> tuple[tuple[float, ...], str]:
    """Return the gains at which lagged, delayed attitude errors fit the rates best, and a note.

    Args:
        source: the log, for messages.
        time: (num_rows,) s.
        channels: as for ``read_commands``.
        errors: of the attitude, (num_rows, 3) rad.
        given: stated gains, rad/s per rad; those of 0 are identified.
    """
    _check_there(source, channels, "w")
    if len(time) < MIN_ROWS:
        raise LogError(
            f"{source}: attitude_command.gain: found {len(time)} rows, too few for it; state it"
        )
    is_flying = channels["thrust_command"][:, 0] > FLYING_THRUST
    step_s, gains, correlations = float(np.median(np.diff(time))), [], []
    for axis, name in enumerate(AXES):
        if given[axis]:
            gains.append(given[axis])
            continue
        best, gain = 0.0, 0.0
        rates = channels["w"][is_flying, axis] - channels["w"][is_flying, axis].mean()
        for delay_s in DELAYS_S:
            delay = round(delay_s / step_s)
            delayed = np.pad(errors[:, axis], (delay, 0))[: len(errors)]
            for lag_s in LAGS_S:
                response = low_pass(delayed, step_s, lag_s)[is_flying]
                response = response - response.mean()
                size = np.linalg.norm(response) * np.linalg.norm(rates)
                correlation = float(response @ rates / size) if size else 0.0
                if correlation > best:
                    best, gain = correlation, float(response @ rates / (response @ response))
        if not best >= MIN_CORRELATION:
            problem = (
                f"rates correlate with the attitude error by {best:.2f}, expected "
                f"{MIN_CORRELATION} or more"
            )
            raise LogError(
                f"{source}: attitude_command.gain: cannot be identified for {name}: {problem}; "
                "state it"
            )
        gains.append(gain)
        correlations.append(best)
    names = ", ".join(name for name, gain in zip(AXES, given, strict=True) if not gain)
    return tuple(gains), f"{names} identified; correlation {_listed(tuple(correlations))}"


def _rates_of_the_law(
    source: str, time: np.ndarray, channels: Channels[str, np.ndarray]
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the rates that torque setpoints track by their law, (num_rows, 3) rad/s, and a note.

    Source: Lee, Leok, McClamroch, CDC 2010, with an integral as in Crazyflie's firmware:
    torque = -KR e - Kw (w - w_reference) - KI integral(e) + constant. Without the last two terms
    this is Kw times the error of the rates from w_reference - KR/Kw e. All factors are identified.
    Assumption: integral and constant balance a steady torque, such as that of uneven motors.
    """
    if "attitude_command" not in channels:
        where = f"{source}: torque_command.rate_gain: missing"
        raise LogError(f"{where}; only with setpoints of attitude it can be identified")
    errors = _rotation_errors(source, channels)
    steps_s = np.where(np.diff(time) > MAX_GAP_S, 0.0, np.diff(time))  # pauses are unknown
    steps = steps_s[:, None] * 0.5 * (errors[1:] + errors[:-1])
    integrals = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    reference = channels.get("reference_rates", np.zeros_like(errors))
    rates = channels["w"] - reference
    ratios, gains, explained_by_axis = [], [], []
    for axis, name in enumerate(AXES):
        torque = channels["torque_command"][:, axis]
        regressors = (errors[:, axis], rates[:, axis], integrals[:, axis], np.ones(len(time)))
        design = np.stack(regressors, axis=1)
        weights = np.linalg.lstsq(design, torque, rcond=None)[0]
        explained_variance = (
            1.0 - float(np.var(torque - design @ weights) / np.var(torque))
            if np.ptp(torque)
            else 0.0
        )
        if not explained_variance >= MIN_EXPLAINED or weights[1] >= 0.0:
            problem = (
                f"attitude and rates explain {explained_variance:.0%} of the torque, expected "
                f"{MIN_EXPLAINED:.0%}"
            )
            where = f"{source}: torque_command.rate_gain: cannot be identified for {name}"
            raise LogError(f"{where}: {problem}; state it")
        ratios.append(float(weights[0] / weights[1]))
        gains.append(-float(weights[1]))
        explained_by_axis.append(f"{explained_variance:.1%}")
    identified = (
        f"identified with Kw {_listed(tuple(gains))} N m s/rad; the law explains "
        f"{', '.join(explained_by_axis)}"
    )
    assumed = "reference rates, and attitude errors times KR/Kw of the torque setpoints' law"
    left_out = "its integral, which holds against steady torques, is left out"
    note = (
        f"{source}: rate commands: {assumed}, {_listed(tuple(ratios))} 1/s ({identified}); "
        f"{left_out}"
    )
    return reference - np.array(ratios) * errors, (note,)


def _rotation_errors(source: str, channels: Channels[str, np.ndarray]) -> np.ndarray:
    """Return the attitude error in the torque setpoints' law, body axes, (num_rows, 3)."""
    estimate = channels.get("own_attitude")
    if estimate is None:
        _check_there(source, channels, "q")
        attitude = Rotation.from_quat(channels["q"], scalar_first=True)
    else:
        attitude = Rotation.from_euler("ZYX", estimate[:, ::-1])
    turn = (
        Rotation.from_euler("ZYX", channels["attitude_command"][:, ::-1]).inv() * attitude
    ).as_matrix()
    return 0.5 * (turn - turn.transpose(0, 2, 1))[:, (2, 0, 1), (1, 2, 0)]
