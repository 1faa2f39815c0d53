"""How a log moves: by which motion, and how late its poses are against its gyro.

A motion is a simulator's step, or the continuous motion of a drone. Half a step of another motion
looks like clocks that are half a step apart, so both are chosen together, where the sensors do not
show the motion by themselves (``motion_of_sensors``). The correlation of gyro
and attitude says how late poses are under each motion. Each is fitted so with the base and the few
effects that can pass for half a step (delays, drag, scales), on some seconds of the log, the
lateness of the likely ones along with it, and the likelihoods of what was logged are compared.
Unlike named effects, motions are not nested, so that a small difference decides. Poses are never
early: where they seem to be, gyro and accelerometer are late.

A simulator's step with poses that are late by half a step is a drone whose poses are on time, but
for the curvature within a step, which a model that lacks something fits worse than it differs. So
who seems on time as a drone is a drone. (On Betaflight, whose rate loop the model lacks, the
likelihoods chose a simulator's step with poses 4.5 ms late for 4 of 5 flights.)
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import BY_NAME, Effect
from flytrack_env.motion import Motion
from flytrack_sysid.diagnosis import noise as noises
from flytrack_sysid.diagnosis.chunks import Chunks, cut_chunks
from flytrack_sysid.diagnosis.lateness import read_poses, scored_as_logged
from flytrack_sysid.diagnosis.motion_of_sensors import apparent_lateness, motion_of_sensors
from flytrack_sysid.diagnosis.problem import Problem, blocks_of, robust_weight
from flytrack_sysid.diagnosis.score_test import Linearization, solve
from flytrack_sysid.diagnosis.search import refine
from flytrack_sysid.log import FlightLog, usual_step
from flytrack_sysid.log_motion import required_motion
from flytrack_sysid.parameters import base_of

CLEAR = 10.0  # of minus twice the log likelihood, by which a simulator's step has to win
# Of it, which poses that are not on time have to gain: effects that are not fitted here change it
# by so much.
LATE = 60.0
NEAR = 300.0  # of it: within so much of the best, lateness is fitted before one is chosen
UNDECIDED = 60.0  # of it: while the second best is so near, more of the log is asked
MAX_CHUNKS = 4  # at a time, evenly spread: twenty seconds decide mostly
# What a correlation has to say: smaller offsets are within its bias, or its standard errors up to a
# bound.
ON_TIME_S, STANDARD_ERRORS, UNCERTAIN_S = 0.7e-3, 3.0, 1.5e-3
MIN_LATENCY_S = 0.5e-3  # of a fitted lateness: a smaller one changes nothing
DIFFERENCE_S, MAX_STEP_S = 2e-4, 3e-3  # for slopes; of a step of the fit
ROUNDS = 2
IMU_LATENCY = "imu_latency.latency_s"
LOOK_ALIKES: tuple[Effect, ...] = tuple(
    BY_NAME[name]
    for name in (
        "command_delay",
        "rate_scale",
        "linear_drag",
        "quadratic_drag",
        "rotor_drag",
        "wind",
        "thrust_tilt",
        "translational_lift",
        "accelerometer_scale",
        "gyro_scale",
        "imu_latency",
    )
)


class MotionEstimate(NamedTuple):
    """How a log moves, and how late its poses are.

    late_s: the poses against the gyro, 0 if on time. sigma_s: the standard error of ``late_s``.
    is_sure: the motion was given, or is what the sensors show.

    While a motion is chosen, ``late_s`` is negative where the gyro and the accelerometer are late.
    """

    motion: Motion
    late_s: float = 0.0
    sigma_s: float = 0.0
    is_sure: bool = False


class Trial(NamedTuple):
    """A motion and a lateness, and what was fitted under them."""

    motion_estimate: MotionEstimate
    problem: Problem
    vector: np.ndarray


def build_problem(
    chunks: Chunks,
    corrected: FlightLog,
    logged: FlightLog,
    model: ModelParameters,
    late_s: float,
) -> Problem:
    """Return the problem of chunks of a corrected log, whose poses were logged late."""
    late = None
    if late_s:
        chunks, late = scored_as_logged(chunks, corrected, logged, late_s, model.motion)
    return Problem.of(chunks, model, late=late)


class LogPart(NamedTuple):
    """Rows of a log to learn from, a model to start from, and the part of the chunks that is used.

    scored_rows: (num_rows,) bool.

    num_parts: of some chunks each.
    """

    log: FlightLog
    scored_rows: np.ndarray
    model: ModelParameters
    part: int = 0
    num_parts: int = 1

    def chunks(self, log: FlightLog) -> Chunks:
        """Return the chunks of this part; in ``log`` poses may be at other times."""
        chunks = cut_chunks(log, self.scored_rows, self.model)
        return chunks.selected(
            np.arange(self.part, chunks.row.shape[1], self.num_parts)[:MAX_CHUNKS]
        )

    def problem(self, motion_estimate: MotionEstimate) -> Problem:
        """Return the problem of a log that moves so."""
        model, late_s = (
            self.model._replace(motion=motion_estimate.motion),
            max(motion_estimate.late_s, 0.0),
        )
        in_time = read_poses(self.log, late_s)[0]
        return build_problem(self.chunks(in_time), in_time, self.log, model, late_s)


def _indices(problem: Problem, motion_estimate: MotionEstimate) -> list[int]:
    """Return what is fitted; sensors are late only where poses would be early."""
    names = [f"{one.name}.{name}" for one in LOOK_ALIKES for name in one.ranges]
    return problem.indices_of(
        [
            *base_of(problem.like),
            *(name for name in names if name != IMU_LATENCY or motion_estimate.late_s < 0.0),
        ]
    )


def _fit(seen: LogPart, motion_estimate: MotionEstimate, last: Trial | None = None) -> Trial:
    """Return a fit, from that of another motion or a similar lateness if there is one."""
    problem = seen.problem(motion_estimate)
    vector = (problem.start if last is None else last.vector).copy()
    if last is None or last.motion_estimate.motion is not motion_estimate.motion:
        latency = problem.names.index(IMU_LATENCY)
        vector[latency] = problem.start[latency] + max(-motion_estimate.late_s, 0.0)
    noise = None if last is None else last.problem.noise
    if noise is None:
        noise = noises.first_guess(problem.chunks, problem.residuals(vector[None])[0])
    for _ in range(2 if last is None else 1):  # what is badly fitted passes for noise at first
        problem = problem.with_noise(noise)
        vector, _ = refine(problem, problem.clipped(vector), _indices(problem, motion_estimate))
        noise = noises.fit_noise(problem.chunks, problem.residuals(vector[None])[0], noise)
    return Trial(motion_estimate, problem.with_noise(noise), vector)


def _with_later_poses(seen: LogPart, trial: Trial) -> MotionEstimate:
    """Return the lateness that fits better, all else refitted, to first order."""
    motion_estimate, problem, vector = trial
    later = seen.problem(motion_estimate._replace(late_s=motion_estimate.late_s + DIFFERENCE_S))
    change = (later.residuals(vector[None]) - problem.residuals(vector[None])) / DIFFERENCE_S
    linearization = Linearization(
        problem, problem.slopes(vector, _indices(problem, motion_estimate))
    )
    root = np.sqrt(robust_weight(linearization.white))
    column = problem.whiten(np.where(problem.counts & later.counts, change, 0.0))
    own, rest = blocks_of(column * root)[:, 0], linearization.columns * blocks_of(root)[:, None]
    across = np.einsum("bpn,bn->p", rest, own)
    share = solve(linearization.total, across)
    information = float(np.sum(own**2) - across @ share)
    score = -float(np.sum(own * blocks_of(linearization.white * root))) - float(
        share @ linearization.score
    )
    step_s = np.clip(score / information, -MAX_STEP_S, MAX_STEP_S)
    return MotionEstimate(
        motion_estimate.motion, motion_estimate.late_s + float(step_s), information**-0.5
    )


def _fit_lateness(seen: LogPart, trial: Trial, rounds: int = ROUNDS) -> Trial:
    """Return the trial with the lateness of its poses fitted, down to none."""
    for _ in range(rounds):
        if trial.motion_estimate.late_s <= 0.0:
            break
        motion_estimate = _with_later_poses(seen, trial)
        trial = _fit(seen, motion_estimate._replace(late_s=max(motion_estimate.late_s, 0.0)), trial)
    return trial


def _misfits(trials: Sequence[Trial]) -> list[float]:
    """Return minus twice the log likelihoods of the rows that all trials judge."""
    counts = np.logical_and.reduce([trial.problem.counts for trial in trials])
    misfits = []
    for _, problem, vector in trials:
        chunks, left = problem.chunks._replace(counts=counts), problem.residuals(vector[None])[0]
        misfits.append(
            noises.total_misfit(chunks, left, noises.fit_noise(chunks, left, problem.noise))
        )
    return misfits


def _costs(trials: Sequence[Trial], misfits: Sequence[float]) -> list[float]:
    """Return the misfits and what it costs that a sensor is late."""
    return [
        misfit + LATE * bool(trial.motion_estimate.late_s)
        for trial, misfit in zip(trials, misfits, strict=True)
    ]


def estimate_motion(
    log: FlightLog, model: ModelParameters, scored_rows: np.ndarray, motion: Motion | None = None
) -> MotionEstimate:
    """Return how a log moves, likeliest on judged rows, (num_rows,) bool, in float64.

    model: where the search starts. motion: the only one that is tried, if given, or if the sensors
    are sure of one. A drone's where the log hardly tells.
    """
    motion = motion_of_sensors(log) if motion is None else motion
    motions, apparent = tuple(Motion) if motion is None else (motion,), apparent_lateness(log)
    late = {one: MotionEstimate(one) for one in motions}
    if apparent is not None:
        offset_s, sigma_s = apparent
        # Rates of a simulator's step are those in its middle.
        half_s = 0.5 * float(np.median(usual_step(log)))
        is_small = max(ON_TIME_S, min(STANDARD_ERRORS * sigma_s, UNCERTAIN_S))
        for one in motions:
            late_s = offset_s if one is Motion.CONTINUOUS else offset_s + half_s
            if abs(late_s) > is_small:
                late[one] = MotionEstimate(one, late_s, sigma_s)
    if motion is not None and late[motion].late_s <= 0.0:
        return MotionEstimate(motion, is_sure=True)
    if apparent is not None and [one for one in motions if late[one] == MotionEstimate(one)] == [
        Motion.CONTINUOUS
    ]:
        return MotionEstimate(Motion.CONTINUOUS)
    seen = LogPart(log, scored_rows & _known_around(log, list(late.values())), model)
    num_parts = max(cut_chunks(log, seen.scored_rows, model).row.shape[1] // MAX_CHUNKS, 1)
    found = _chosen(seen._replace(num_parts=num_parts), list(late.values()))
    is_late = found.late_s > max(MIN_LATENCY_S, STANDARD_ERRORS * found.sigma_s)
    found = found if is_late else MotionEstimate(found.motion)
    return found._replace(is_sure=motion is not None)


def _known_around(log: FlightLog, motion_estimate: Sequence[MotionEstimate]) -> np.ndarray:
    """Return the rows at which poses are known for each lateness and a few fit steps around it."""
    room = ROUNDS * MAX_STEP_S + DIFFERENCE_S
    late_s = [one.late_s for one in motion_estimate if one.late_s > 0.0]
    ends = (min(0.0, min(late_s) - room), max(late_s) + room) if late_s else (0.0,)
    return np.logical_and.reduce([read_poses(log, end_s)[1] for end_s in ends])


def _chosen(seen: LogPart, late: Sequence[MotionEstimate]) -> MotionEstimate:
    """Return the likeliest of several; those that come near the best are fitted further."""
    first = _fit(seen, late[0])
    trials = [first, *(_fit(seen, motion_estimate, first) for motion_estimate in late[1:])]
    misfits = _misfits(trials)
    trials = [
        _fit_lateness(seen, trial) if misfit < min(misfits) + NEAR else trial
        for trial, misfit in zip(trials, misfits, strict=True)
    ]
    misfits = _misfits(trials)
    for part in range(1, seen.num_parts):
        costs = _costs(trials, misfits)
        kept = [index for index, cost in enumerate(costs) if cost < min(costs) + UNDECIDED]
        if len(kept) < 2:
            break
        other, trials = seen._replace(part=part), [trials[index] for index in kept]
        again = [
            _fit_lateness(other, _fit(other, one.motion_estimate, one), rounds=1) for one in trials
        ]
        misfits = list(np.array(misfits)[kept] + _misfits(again))
        trials = [_both(*pair) for pair in zip(trials, again, strict=True)]
    costs = _costs(trials, misfits)
    for trial, cost in zip(trials, costs, strict=True):
        if trial.motion_estimate.motion is Motion.CONTINUOUS and cost <= min(costs) + CLEAR:
            return trial.motion_estimate
    return trials[int(np.argmin(costs))].motion_estimate


def _both(first: Trial, second: Trial) -> Trial:
    """Return the second trial with the lateness that both say."""
    one_s, sigma_s = first.motion_estimate.late_s, first.motion_estimate.sigma_s
    other_s, other_sigma_s = second.motion_estimate.late_s, second.motion_estimate.sigma_s
    if one_s <= 0.0:
        return second
    weights = np.array([sigma_s, other_sigma_s]) ** -2.0
    late_s = float(weights @ [one_s, other_s] / weights.sum())
    sigma_s = float(weights.sum() ** -0.5)
    return second._replace(
        motion_estimate=first.motion_estimate._replace(late_s=late_s, sigma_s=sigma_s)
    )


def likelier_motion(problem: Problem, vector: np.ndarray) -> Motion:
    """Return the motion with the least misfit of a fitted model, its own unless clearly beaten.

    Before the search, what the model lacks may fit another simulator's step better than the true
    one. Of 18 plants (benchmarks.beyond, seed 43) this was chosen on one, and only there another
    won afterwards.
    """

    def misfit(motion: Motion) -> float:
        moving = replace(problem, like=problem.like._replace(motion=motion))
        left = moving.residuals(vector[None])[0]
        noise = noises.fit_noise(problem.chunks, left, problem.noise)
        return noises.total_misfit(problem.chunks, left, noise) - CLEAR * (
            motion is problem.like.motion
        )

    return min(Motion, key=misfit)


def motion_of(log: FlightLog, model: ModelParameters) -> Motion:
    """Return continuous for a measured log, else the likeliest motion.

    model: where the search starts.

    Without gyro and attitude a log shows no turns, and the model's own motion is returned.
    """
    if (required := required_motion(log)) is not None:
        return required
    if "w" not in log and "q" not in log:
        return model.motion
    if (shown := motion_of_sensors(log)) is not None:
        return shown
    with jax.enable_x64(True):
        return estimate_motion(log, model, np.ones(len(log), bool)).motion
