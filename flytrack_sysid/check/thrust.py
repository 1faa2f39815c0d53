"""The thrust command against the force along the body's z axis, and motors against the rotation."""

import itertools
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from flytrack_env.motors import SIGNS
from flytrack_sysid.check.commands import GRID_S, follow
from flytrack_sysid.check.explain import Change
from flytrack_sysid.check.motion import MARGIN, MAX_CORRELATION, useful_windows, weight_of
from flytrack_sysid.kinematics import GRAVITY, WINDOWS_S, Windows, attitude_of, cut_windows
from flytrack_sysid.log import FlightLog

DELAYS_S = np.arange(0.0, 0.15, GRID_S)  # of the force behind the command
MIN_CORRELATION = 0.5  # of the force with the command, on either side of 0
CLEAR, FLOWN = 0.9, (0.02, 0.98)  # correlation, and quantiles of the commands, for the hover
MIN_SPREAD = 0.5  # m/s^2, rms of the force about its mean: less is drag and noise
PWM = (900.0, 2200.0)  # us, all that flight controllers use
MOTOR_LAG_S = 0.03
UP = np.array([0.0, 0.0, 1.0])
# Signs of the moments of motors 1 to 4 of Betaflight's "Quad X". Yaw is not compared: propellers
# turn in or out.
MOMENTS = SIGNS[:2]


def force_along_z(log: FlightLog, windows: Windows) -> np.ndarray | None:
    """Return the specific force along the body's z axis, (num_windows,), or None if unknown.

    It is measured, or follows from velocity and attitude; the log has right axes and scales.
    """
    if "f" in log:
        return windows.mean_of(log, log["f"][:, 2:])[:, 0]
    if "q" not in log or "v" not in log:
        return None
    up_w = attitude_of(log).apply(UP)
    changes = windows.mean_rate(log["v"])
    return np.sum((changes + UP * GRAVITY) * windows.mean_of(log, up_w), axis=1)


class Followed(NamedTuple):
    """The force along the body's z axis, and the thrust command that it follows.

    Attributes:
        commands: with the dead time that fits best, (num_windows,).
        force: specific, (num_windows,) m/s^2.
        correlation: of both; negative for a command that is upside down.
    """

    commands: np.ndarray
    force: np.ndarray
    correlation: float


def follow_thrust(log: FlightLog) -> Followed | None:
    """Return how the force follows the thrust command; None if the log does not show it."""
    thrust = log["u"][:, 3:]
    windows = cut_windows(log, WINDOWS_S[0])
    force = force_along_z(log, windows) if len(windows.starts) else None
    if force is None or np.std(force) < MIN_SPREAD or not np.ptp(thrust):
        return None
    found = []
    for delay_s in DELAYS_S:
        commands = windows.mean_of(log, follow(log, thrust, delay_s, 0.0))[:, 0]
        correlation = float(np.corrcoef(commands, force)[0, 1])
        found.append(Followed(commands, force, correlation))
    return max(found, key=lambda one: abs(one.correlation))


def thrust_changes(log: FlightLog) -> list[Change]:
    """Return what differs in the thrust command: its range or its sign."""
    low, high = np.min(log["u"][:, 3]), np.max(log["u"][:, 3])
    if low >= PWM[0] and high <= PWM[1]:
        return [Change("u_thrust", "range", "pwm")]
    found = follow_thrust(log)
    if found is None or abs(found.correlation) < MIN_CORRELATION:
        return []
    if found.correlation < 0.0:
        return [Change("u_thrust", "axes", "-")]
    # Thrust is between linear and quadratic in the command above that of no thrust.
    errors = {}
    for zero in (-1.0, 0.0):
        above = np.maximum(found.commands - zero, 0.0)
        design = np.stack([above, above**2], axis=1)
        errors[zero] = nnls(design, found.force)[1] ** 2
    nats = 0.5 * weight_of(WINDOWS_S[0]) * len(found.force) * np.log(errors[-1.0] / errors[0.0])
    return [Change("u_thrust", "range", "0..1")] * bool(nats > MARGIN)


def hover_command(log: FlightLog) -> float | None:
    """Return the thrust command whose mean force is the weight; None where it is not flown.

    The log has right axes, scales and commands.
    """
    found = follow_thrust(log)
    if found is None or found.correlation < CLEAR:
        return None
    curve = np.polyfit(found.commands, found.force, 2)
    low, high = np.quantile(found.commands, FLOWN)
    tried = np.linspace(low, high, 201)
    forces = np.maximum.accumulate(np.polyval(curve, tried))
    if not forces[0] < GRAVITY < forces[-1]:
        return None
    return float(np.interp(GRAVITY, forces, tried))


def motor_changes(log: FlightLog, motors: np.ndarray) -> list[tuple[Change, ...]]:
    """Return orders of the motors by which their torques turn the craft; [()] if theirs does.

    Args:
        log: with right axes.
        motors: outputs of four motors, (num_rows, 4).
    """
    if "w" not in log or motors.shape[1] != 4:
        return [()]
    found = []
    for length_s, windows in useful_windows(log):
        turned = windows.mean_rate(log["w"])
        pushed = windows.mean_of(log, follow(log, motors, 0.0, MOTOR_LAG_S))
        pushed = pushed - pushed.mean(axis=0)
        nats = {}
        for order in itertools.permutations(range(4)):
            # The column of motor order[k] holds motor k: moments in the order of the columns.
            moments = pushed @ MOMENTS[:, order].T
            total = 0.0
            for axis in range(2):
                size = np.linalg.norm(moments[:, axis]) * np.linalg.norm(turned[:, axis])
                correlation = moments[:, axis] @ turned[:, axis] / max(size, 1e-12)
                total -= np.log1p(-(np.clip(correlation, 0.0, MAX_CORRELATION) ** 2))
            nats[order] = 0.5 * weight_of(length_s) * len(turned) * total
        found.append(nats)
    if not found:
        return [()]
    best = max(found, key=lambda nats: max(nats.values()))
    highest = max(best.values())
    if highest - best[0, 1, 2, 3] < MARGIN:
        return [()]
    alike = [order for order, value in best.items() if value > highest - MARGIN]
    moved = [sum(k != motor for k, motor in enumerate(order)) for order in alike]
    return [
        (Change("motors", "order", " ".join(str(motor + 1) for motor in order)),)
        for order, count in zip(alike, moved, strict=True)
        if count == min(moved)
    ]
