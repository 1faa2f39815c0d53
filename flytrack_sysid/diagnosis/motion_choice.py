"""Which motion a log shows: a simulator's step, or the continuous motion of a drone.

Each motion is fitted with the base and the few effects that can pass for half a step of another motion
(a delay, a latency, drag, scales), on some seconds of the log, and the likelihoods are compared. Unlike
named effects, motions are not nested, so that a small difference decides; a minute's log tells them apart by
hundreds to thousands.
"""

from collections.abc import Mapping

import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import BY_NAME, Effect
from flytrack_env.motion import Motion
from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis.lanes import Lanes, make_lanes
from flytrack_sysid.diagnosis.problem import Problem
from flytrack_sysid.diagnosis.score_test import BASE_FREE
from flytrack_sysid.diagnosis.search import refine
from flytrack_sysid.log import FlightLog

CLEAR = 10.0  # of minus twice the log likelihood, by which a simulator's step has to win
MOST_LANES = 4  # evenly spread: twenty seconds decide
LOOK_ALIKES: tuple[Effect, ...] = tuple(
    BY_NAME[name]
    for name in (
        "command_delay",
        "rate_scale",
        "linear_drag",
        "imu_latency",
        "accelerometer_scale",
        "gyro_scale",
    )
)


def misfit_of(lanes: Lanes, model: ModelParameters) -> float:
    """Return minus twice the log likelihood of a log under a model's motion, all else fitted."""
    problem = Problem.of(lanes, model, LOOK_ALIKES)
    fields = [f"{effect.name}.{name}" for effect in LOOK_ALIKES for name in effect.ranges]
    places = problem.index([*BASE_FREE, *fields])
    vector = problem.start
    noise = noises.first_guess(lanes, problem.residuals(vector[None])[0])
    for _ in range(2):  # what is badly fitted passes for noise at first
        problem = problem.with_noise(noise)
        vector, _ = refine(problem, vector, places)
        left = problem.residuals(vector[None])[0]
        noise = noises.fit_noise(lanes, left, noise)
    return noises.total_misfit(lanes, left, noise)


def motion_of(log: FlightLog, model: ModelParameters) -> Motion:
    """Return the motion under which a log is likeliest. model: where the search starts.

    Without gyro and attitude a log shows no turns, and the model's own motion is returned.
    """
    if "w" not in log and "q" not in log:
        return model.motion
    with jax.enable_x64(True):
        lanes = make_lanes(log, np.ones(len(log), bool), np.asarray(model.tau, float), float(model.g))
        return likeliest_motion(lanes, model)


def likeliest_motion(lanes: Lanes, model: ModelParameters) -> Motion:
    """Return the motion under which a log is likeliest, in float64; a drone's where the log hardly tells."""
    misfits = motion_misfits(lanes, model)
    best = min(misfits, key=lambda motion: misfits[motion])
    is_clear = misfits[Motion.CONTINUOUS] - misfits[best] > CLEAR
    return best if is_clear else Motion.CONTINUOUS


def motion_misfits(lanes: Lanes, model: ModelParameters) -> Mapping[Motion, float]:
    """Return minus twice the log likelihood of a log by motion, in float64."""
    number = lanes.row.shape[1]
    if number > MOST_LANES:
        lanes = lanes.selected(np.linspace(0, number - 1, MOST_LANES).round().astype(int))
    return {motion: misfit_of(lanes, model._replace(motion=motion)) for motion in Motion}
