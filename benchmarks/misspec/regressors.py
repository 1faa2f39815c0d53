"""The package's list of effects as features that are linear in their parameters, for regression.

Lags, thrust curve and drain are taken as known, which they are on this suite. Laws that are not
linear in their parameters are linearised at neutral: an author of a sparse regression has no other
way. Where two effects have the same feature, one is left out and named in the comment.
"""

from typing import NamedTuple

import numpy as np

from benchmarks.misspec.replay import UP, Replay, State

LIFT_MS, GROUND_M, BENT = 5.0, 0.3, 0.5  # scales of lift and ground effect; stick of saturation
AXES, STICKS = "xyz", ("roll", "pitch", "yaw")


class Feature(NamedTuple):
    """A parameter's feature: what one unit of it adds to the body's motion and to the sensors.

    Attributes:
        name: ``effect.parameter``.
        neutral: the parameter's value at which it does nothing.
        force_b: m/s^2, (n, 3) or (3,); felt by the accelerometer, too.
        rates_b: rad/s, the same; read by the gyro, too.
        accelerometer: what only the accelerometer has.
        gyro: what only the gyro has.
    """

    name: str
    neutral: float = 0.0
    force_b: np.ndarray = np.zeros(3)
    rates_b: np.ndarray = np.zeros(3)
    accelerometer: np.ndarray = np.zeros(3)
    gyro: np.ndarray = np.zeros(3)


def along(axis: int, values: np.ndarray) -> np.ndarray:
    """Return vectors along an axis, (n, 3)."""
    return values[:, None] * np.eye(3)[axis]


def moving(state: State, full_rates: np.ndarray) -> list[Feature]:
    """Return the features of effects on the motion."""
    vel_b, thrust, rates_b, turning = state.vel_b, state.thrust, state.rates_b, state.turning_b
    speed = np.linalg.norm(vel_b, axis=1)
    across2 = np.sum(vel_b[:, :2] ** 2, axis=1)
    thrust_b = thrust[:, None] * UP
    lift = across2 / (across2 + LIFT_MS**2)
    ground = 1.0 / (1.0 + (state.pos_w[:, 2] / GROUND_M) ** 2)
    falling = np.where(state.slope[:, 3] < 0.0, state.jerk, 0.0)
    features = [
        Feature("thrust_scale.factor", 1.0, thrust_b),
        Feature("translational_lift.gain", 0.0, thrust_b * lift[:, None]),
        Feature("ground_effect.gain", 0.0, thrust_b * ground[:, None]),
        Feature("rotor_drag.h", 0.0, -thrust[:, None] * vel_b * [1.0, 1.0, 0.0]),
        Feature("thrust_tilt.towards_x", 0.0, along(0, thrust)),
        Feature("thrust_tilt.towards_y", 0.0, along(1, thrust)),
        Feature("voltage_sag.at_full_v", 0.0, along(2, state.sag)),
        Feature("thrust_lag_asymmetry.ratio", 1.0, along(2, -falling)),
        Feature("yaw_reaction.angle", rates_b=along(2, state.slope[:, 3])),
        Feature("motor_imbalance.roll", rates_b=along(0, thrust)),
        Feature("motor_imbalance.pitch", rates_b=along(1, thrust)),
        Feature("rate_cross_coupling.from_roll", rates_b=along(2, rates_b[:, 0])),
        Feature("rate_cross_coupling.from_pitch", rates_b=along(2, rates_b[:, 1])),
        Feature("command_delay.delay_s", force_b=along(2, -state.jerk), rates_b=-turning),
    ]
    for i, axis in enumerate(AXES):
        world_b = state.attitude.inv().apply(np.tile(np.eye(3)[i], (len(thrust), 1)))
        features += [
            Feature(f"wind.a_{axis}", 0.0, world_b),
            Feature(f"linear_drag.d_{axis}", 0.0, along(i, -vel_b[:, i])),
            # Both usual laws: each axis for itself, and times the whole speed.
            Feature(f"quadratic_drag.k_{axis}", 0.0, along(i, -np.abs(vel_b[:, i]) * vel_b[:, i])),
            Feature(f"quadratic_drag.shared_{axis}", 0.0, along(i, -speed * vel_b[:, i])),
        ]
    for i, stick in enumerate(STICKS):
        u, full = state.applied[:, i], full_rates[i]
        bent = np.sign(u) * np.maximum(np.abs(u) - BENT, 0.0)
        features += [
            Feature(f"rate_scale.{stick}", 1.0, rates_b=along(i, rates_b[:, i])),
            Feature(f"rate_expo.{stick}", 0.0, rates_b=along(i, full * (u**3 - u))),
            Feature(f"rate_saturation.{stick}", 0.0, rates_b=along(i, -full * bent)),
            # A lag of the same axis has the same feature.
            Feature(f"second_order_rates.{stick}_s", 0.0, rates_b=along(i, -turning[:, i])),
            Feature(
                f"rate_slew_limit.{stick}_s",
                0.0,
                rates_b=along(i, -turning[:, i] * np.abs(state.slope[:, i])),
            ),
        ]
    return features


def sensing(state: State) -> list[Feature]:
    """Return the features of effects on the sensors."""
    thrust, rates_b, turning = state.thrust, state.rates_b, state.turning_b
    late = Feature("imu_latency.latency_s", accelerometer=along(2, -state.jerk), gyro=-turning)
    # Sideways the model has no force, so that a scale there has no feature.
    features = [late, Feature("accelerometer_scale.z", 1.0, accelerometer=along(2, thrust))]
    ones = np.ones(len(thrust))
    for i, axis in enumerate(AXES):
        arm = np.eye(3)[i]
        lever = np.cross(rates_b, np.cross(rates_b, arm)) + np.cross(turning, arm)
        features += [
            Feature(f"accelerometer_bias.{axis}", accelerometer=along(i, ones)),
            Feature(f"gyro_bias.{axis}", gyro=along(i, ones)),
            Feature(f"gyro_scale.{axis}", 1.0, gyro=along(i, rates_b[:, i])),
            Feature(f"imu_offset.{axis}", accelerometer=lever),
        ]
    return features


def column(replay: Replay, feature: Feature, scales: np.ndarray) -> np.ndarray:
    """Return a feature's column over all measurements, each over its noise."""
    nothing = np.zeros_like(replay.gyro)
    force, rates = nothing + feature.force_b, nothing + feature.rates_b
    gyro, felt = rates + feature.gyro, force + feature.accelerometer
    return _over_noise([gyro, felt, replay.turned(rates), replay.pushed(force)], scales)


def targets(replay: Replay) -> tuple[np.ndarray, np.ndarray]:
    """Return all measurements over their noise, and the noise by channel and axis, (4, 3).

    The noise is the median absolute deviation of differences between neighbours.
    """
    parts = [replay.gyro, replay.force, replay.turning, replay.pushing]
    scales = np.array(
        [1.4826 / np.sqrt(2.0) * np.median(np.abs(np.diff(part, axis=0)), axis=0) for part in parts]
    )
    return _over_noise(parts, scales), scales


def _over_noise(parts: list[np.ndarray], scales: np.ndarray) -> np.ndarray:
    return np.concatenate(
        [(part / scale).ravel() for part, scale in zip(parts, scales, strict=True)]
    )
