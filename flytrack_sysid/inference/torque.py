"""Whether a log shows the torque of its motors: only then inertia, lags and single motors show.

On ten logs the correlation was 0.87 to 0.95 or 0.16 to 0.74 (docs/results/motors.md). Of
the former, radii of gyration came out within 6 % of the published ones where there are any; of the
latter, up to eleven times too large.
"""

from typing import Any, NamedTuple

import numpy as np

from flytrack_env.dynamics import ModelParameters, collective_thrust
from flytrack_env.effects import takes_motors
from flytrack_env.motors import NAMES
from flytrack_sysid.inference.chunks import Chunks
from flytrack_sysid.kinematics import low_pass
from flytrack_sysid.log import FlightLog, median_step
from flytrack_sysid.log_voltage import flown_voltages

AXES = ("roll", "pitch")  # yaw is turned by little, and by rotors that spin up
WINDOW_S = 0.05  # of changes of the rates: noise of a gyro is small beside them
MAX_LATE_S, LATE_STEP_S = 0.04, 0.005  # of the rates behind the motors, beside their lag
MIN_CORRELATION = 0.8  # between the two groups of ten logs; chosen on them
MIN_ROWS = 100  # of a correlation: fewer say nothing
# What shows in torques about an axis only. Without both axes, lags, which a noisy torque fits best
# at their bound, are unseen, too.
FIELDS = {
    "roll": ("motors.radius_x", "motors.center_y"),
    "pitch": ("motors.radius_y", "motors.center_x"),
}
OF_BOTH = ("motors.radius_z", "motors.up_s", "motors.down_s")
# What the noise of an unseen axis passes for: modelled rates are of noise then, which a damping or
# a gyro's scale would shrink.
OF_EITHER = (
    *(f"motors.{name}" for name in (*NAMES, "damping_x", "damping_y", "damping_z")),
    *(f"gyro_scale.{axis}" for axis in "xyz"),
)


class MotorRecord(NamedTuple):
    """Outputs of motors and body rates, side by side in chunks.

    Attributes:
        commands: of the motors, -1 to 1, (rows, chunks, 4).
        rates_b: rad/s, (rows, chunks, 3).
        is_joined: the row follows the one before it in flight, (rows, chunks) bool.
        step_s: between rows, s.
        battery_v: V.
    """

    commands: np.ndarray
    rates_b: np.ndarray
    is_joined: np.ndarray
    step_s: float
    battery_v: float

    @classmethod
    def of_log(cls, log: FlightLog) -> "MotorRecord":
        """Return the record of a log, in one chunk."""
        step_s = median_step(log)
        voltage = float(np.mean(flown_voltages(log)))
        is_joined = ~log.is_start()[:, None]
        return cls(log["u"][:, None], log["w"][:, None], is_joined, step_s, voltage)

    @classmethod
    def of_chunks(cls, chunks: Chunks) -> "MotorRecord":
        """Return the record of chunks."""
        record = chunks.record
        step_s, voltage = record.median_step_s, float(np.median(record.battery_v))
        rates_b = chunks.measured["w"]
        return cls(record.command, rates_b, chunks.is_joined, step_s, voltage)


def torque_correlations(model: ModelParameters, record: MotorRecord) -> np.ndarray:
    """Return how changes of roll and pitch rate correlate with the torque of the motors, (2,).

    The torque is that of the model's thrust map, levers and lag, integrated over ``WINDOW_S``; of
    some latencies the best counts. NaN where too few rows are there.
    """
    motors, coeffs = model.effect("motors"), np.asarray(model.thrust_coeffs, float)
    lag_s = 0.5 * float(motors.up_s + motors.down_s)
    lagged = low_pass(record.commands, record.step_s, lag_s)
    thrusts = np.asarray(collective_thrust(lagged, record.battery_v, coeffs))
    levers: Any = np.array([[float(arm) for arm in lever] for lever in motors.levers])
    impulse = np.cumsum(thrusts @ levers[:, : len(AXES)], axis=0)
    window = max(1, round(WINDOW_S / record.step_s))
    num_breaks = np.cumsum(~record.is_joined, axis=0)
    best = np.full(len(AXES), np.nan)
    for late_s in np.arange(0.0, MAX_LATE_S, max(LATE_STEP_S, record.step_s)):
        late = round(late_s / record.step_s)
        end = len(impulse) - late
        if end <= window:
            break
        given = impulse[window:end] - impulse[: end - window]
        rates_b = record.rates_b[late:, :, : len(AXES)]
        found = rates_b[window:] - rates_b[:-window]
        is_used = np.isfinite(found).all(axis=-1)
        is_used &= num_breaks[window + late :] == num_breaks[: end - window]
        if is_used.sum() < MIN_ROWS:
            break
        for axis in range(len(AXES)):
            pair = given[is_used, axis], found[is_used, axis]
            is_moved = min(map(np.ptp, pair)) > 0.0  # an axis that rests shows nothing
            best[axis] = np.fmax(best[axis], np.corrcoef(*pair)[0, 1] if is_moved else 0.0)
    return best


def unseen_fields(correlations: np.ndarray) -> tuple[str, ...]:
    """Return the base parameters that a log does not show, by correlations of roll and pitch."""
    unseen = [
        axis for axis, value in zip(AXES, correlations, strict=True) if value < MIN_CORRELATION
    ]
    fields = tuple(field for axis in unseen for field in FIELDS[axis])
    return fields + OF_BOTH if len(unseen) == len(AXES) else fields


def unseen_in_log(log: FlightLog, model: ModelParameters) -> tuple[str, ...]:
    """Return the parameters that a log does not show; none of a log without motors."""
    if not log.has_motors or "w" not in log:
        return ()
    return unseen_fields(torque_correlations(model, MotorRecord.of_log(log)))


def unseen_in_chunks(chunks: Chunks, model: ModelParameters) -> tuple[str, ...]:
    """Return the parameters that chunks do not show, of the base and of effects.

    Without motors there are none.
    """
    if not takes_motors(model.effects) or "w" not in chunks.measured:
        return ()
    unseen = unseen_fields(torque_correlations(model, MotorRecord.of_chunks(chunks)))
    return (*unseen, *OF_EITHER) if unseen else ()


def torque_notes(log: FlightLog, model: ModelParameters) -> list[str]:
    """Return a note if a log of motors does not show their torque."""
    unseen = unseen_in_log(log, model)
    if not unseen:
        return []
    values = torque_correlations(model, MotorRecord.of_log(log))
    found = ", ".join(
        f"{axis} {value:.2f}" for axis, value in zip(AXES, values, strict=True) if value == value
    )
    return [
        f"{log.source} hardly shows the motors' torque: it correlates with changes of the rates by "
        f"{found}, expected {MIN_CORRELATION} or more; {', '.join(unseen)} are held at the "
        "model's, and damping, single motors and a gyro's scale are not named: log motors and gyro "
        "faster, or roll and pitch more"
    ]
