"""Choose the motion of a log, and estimate how late its poses are against its gyro.

A motion is a simulator's step, or the continuous motion of a drone. Half a step of another motion
looks like clocks that are half a step apart. So both are chosen together, if the sensors do not
show the motion by themselves (``motion_of_sensors``). The correlation of gyro and attitude gives
the lateness of poses under each motion. Each motion is fitted with that lateness on some seconds of
the log, with the base and the few effects that can pass for half a step (delays, drag, scales). For
the likely motions, the lateness is fitted as well. Then the likelihoods of the logged poses are
compared. Unlike named effects, motions are not nested, so that a small difference decides. Poses
are never early: where they seem to be, gyro and accelerometer are late.

A simulator's step with poses late by half a step equals a drone with poses on time, except for the
curvature within a step. The misfit of an incomplete model is larger than this difference. So a log
whose poses seem on time under continuous motion is taken for a drone's. (On Betaflight, whose rate
loop the model lacks, the likelihoods chose a simulator's step with poses 4.5 ms late for 4 of 5
flights.)
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import BY_NAME, Effect
from flytrack_env.motion import Motion
from flytrack_sysid.diagnosis.motion_of_sensors import apparent_lateness, motion_of_sensors
from flytrack_sysid.inference import noise as noises
from flytrack_sysid.inference.chunks import Chunks, cut_chunks
from flytrack_sysid.inference.lateness import read_poses, scored_as_logged
from flytrack_sysid.inference.parameters import base_of, fields_of_sticks
from flytrack_sysid.inference.problem import (
    Problem,
    merge_seconds,
    robust_weight,
    split_blocks,
    split_seconds,
)
from flytrack_sysid.inference.score_test import Linearization, solve
from flytrack_sysid.inference.search import refine
from flytrack_sysid.log import FlightLog, median_step
from flytrack_sysid.log_motion import required_motion

CLEAR = 10.0  # of minus twice the log likelihood: a simulator's step has to be better by this
# Of the same: the gain that late poses need. Effects that are not fitted here change it by as much.
LATE = 60.0
NEAR = 300.0  # of the same: trials this close to the best have their lateness fitted
UNDECIDED = 60.0  # of the same: while the second best is this close, more of the log is used
MAX_CHUNKS = 4  # at a time, evenly spread: twenty seconds mostly suffice
# The least offset that a correlation shows: smaller ones are within its bias, or within its
# standard errors, up to a bound.
ON_TIME_S, STANDARD_ERRORS, UNCERTAIN_S = 0.7e-3, 3.0, 1.5e-3
MIN_LATENCY_S = 0.5e-3  # of a fitted lateness: a smaller one has no effect
DIFFERENCE_S, MAX_STEP_S = 2e-4, 3e-3  # for slopes; of a step of the fit
ROUNDS = 2  # of Gauss-Newton for the lateness
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
    """The motion of a log, and how late its poses are.

    Attributes:
        motion: a simulator's step, or continuous.
        late_s: lateness of the poses against the gyro, 0 if on time. While a motion is chosen, it
            is negative where the gyro and the accelerometer are late.
        sigma_s: standard error of ``late_s``.
        is_sure: the motion was given, or is shown by the sensors.
    """

    motion: Motion
    late_s: float = 0.0
    sigma_s: float = 0.0
    is_sure: bool = False


class Trial(NamedTuple):
    """A motion and a lateness, and the noise and the model fitted under them."""

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
    """Rows of a log to learn from, and the part of the chunks that is used.

    Attributes:
        log: with poses as logged.
        scored_rows: the rows to learn from, (num_rows,) bool.
        model: to start from.
        part: the part that is used.
        num_parts: the number of parts, of some chunks each.
    """

    log: FlightLog
    scored_rows: np.ndarray
    model: ModelParameters
    part: int = 0
    num_parts: int = 1

    def chunks(self, log: FlightLog) -> Chunks:
        """Return the chunks of this part.

        Args:
            log: the log; its poses may be at other times.
        """
        chunks = cut_chunks(log, self.scored_rows, self.model)
        return chunks.selected(
            np.arange(self.part, chunks.row.shape[1], self.num_parts)[:MAX_CHUNKS]
        )

    def problem(self, motion_estimate: MotionEstimate) -> Problem:
        """Return the problem of this part under a motion and a lateness."""
        model, late_s = (
            self.model._replace(motion=motion_estimate.motion),
            max(motion_estimate.late_s, 0.0),
        )
        in_time = read_poses(self.log, late_s)[0]
        return build_problem(self.chunks(in_time), in_time, self.log, model, late_s)


def _indices(problem: Problem, motion_estimate: MotionEstimate) -> list[int]:
    """Return the indices that are fitted; the sensors' latency only if poses would be early."""
    names = [f"{effect.name}.{name}" for effect in LOOK_ALIKES for name in effect.ranges]
    unknown = fields_of_sticks(problem.like)
    return problem.parameter_indices(
        [
            *base_of(problem.like),
            *(
                name
                for name in names
                if name not in unknown and (name != IMU_LATENCY or motion_estimate.late_s < 0.0)
            ),
        ]
    )


def _fit(log_part: LogPart, motion_estimate: MotionEstimate, last: Trial | None = None) -> Trial:
    """Return a fit, started from that of another motion or a similar lateness if there is one."""
    problem = log_part.problem(motion_estimate)
    vector = (problem.start if last is None else last.vector).copy()
    if last is None or last.motion_estimate.motion is not motion_estimate.motion:
        latency = problem.names.index(IMU_LATENCY)
        vector[latency] = problem.start[latency] + max(-motion_estimate.late_s, 0.0)
    noise = None if last is None else last.problem.noise
    if noise is None:
        noise = noises.first_guess(problem.chunks, problem.residuals(vector[None])[0])
    for _ in range(2 if last is None else 1):  # a bad first fit makes the noise too large
        problem = problem.with_noise(noise)
        vector, _ = refine(problem, problem.clipped(vector), _indices(problem, motion_estimate))
        noise = noises.fit_noise(problem.chunks, problem.residuals(vector[None])[0], noise)
    return Trial(motion_estimate, problem.with_noise(noise), vector)


def _with_later_poses(log_part: LogPart, trial: Trial) -> MotionEstimate:
    """Return the lateness that fits best to first order, with all other parameters refitted."""
    motion_estimate, problem, vector = trial
    later = log_part.problem(motion_estimate._replace(late_s=motion_estimate.late_s + DIFFERENCE_S))
    change = (later.residuals(vector[None]) - problem.residuals(vector[None])) / DIFFERENCE_S
    linearization = Linearization(
        problem, problem.slopes(vector, _indices(problem, motion_estimate))
    )
    root = np.sqrt(robust_weight(linearization.white))
    column = problem.whiten(np.where(problem.counts & later.counts, change, 0.0))
    late = split_blocks(column * root)[:, 0]
    given = merge_seconds(linearization.columns * split_seconds(root)[:, :, None])
    across = np.einsum("bpn,bn->p", given, late)
    share = solve(linearization.total, across)
    information = float(np.sum(late**2) - across @ share)
    score = -float(np.sum(late * split_blocks(linearization.white * root))) - float(
        share @ linearization.score
    )
    step_s = np.clip(score / information, -MAX_STEP_S, MAX_STEP_S)
    return MotionEstimate(
        motion_estimate.motion, motion_estimate.late_s + float(step_s), information**-0.5
    )


def _fit_lateness(log_part: LogPart, trial: Trial, rounds: int = ROUNDS) -> Trial:
    """Return the trial with the lateness of its poses fitted, not below 0."""
    for _ in range(rounds):
        if trial.motion_estimate.late_s <= 0.0:
            break
        motion_estimate = _with_later_poses(log_part, trial)
        trial = _fit(
            log_part, motion_estimate._replace(late_s=max(motion_estimate.late_s, 0.0)), trial
        )
    return trial


def _misfits(trials: Sequence[Trial]) -> list[float]:
    """Return minus twice the log likelihoods of the rows that all trials score."""
    counts = np.logical_and.reduce([trial.problem.counts for trial in trials])
    misfits = []
    for _, problem, vector in trials:
        chunks, residuals = (
            problem.chunks._replace(counts=counts),
            problem.residuals(vector[None])[0],
        )
        misfits.append(
            noises.total_misfit(
                chunks, residuals, noises.fit_noise(chunks, residuals, problem.noise)
            )
        )
    return misfits


def _costs(trials: Sequence[Trial], misfits: Sequence[float]) -> list[float]:
    """Return the misfits plus the price of a late sensor."""
    return [
        misfit + LATE * bool(trial.motion_estimate.late_s)
        for trial, misfit in zip(trials, misfits, strict=True)
    ]


def estimate_motion(
    log: FlightLog, model: ModelParameters, scored_rows: np.ndarray, motion: Motion | None = None
) -> MotionEstimate:
    """Return the likeliest motion and lateness of a log, in float64.

    The motion is continuous where the log hardly decides.

    Args:
        log: with poses as logged.
        model: where the search starts.
        scored_rows: the rows that decide, (num_rows,) bool.
        motion: the only one that is tried; if None, the one that the sensors clearly show, else
            all.
    """
    motion = motion_of_sensors(log) if motion is None else motion
    motions, apparent = tuple(Motion) if motion is None else (motion,), apparent_lateness(log)
    estimates = [MotionEstimate(candidate) for candidate in motions]
    if apparent is not None:
        # Rates of a simulator's step are those in its middle.
        half_s = 0.5 * median_step(log)
        estimates = _apparent_estimates(motions, *apparent, half_s)
    if motion is not None and estimates[0].late_s <= 0.0:
        return MotionEstimate(motion, is_sure=True)
    if apparent is not None and [
        estimate.motion for estimate in estimates if not estimate.late_s
    ] == [Motion.CONTINUOUS]:
        return MotionEstimate(Motion.CONTINUOUS)
    if motion is None and all(estimate.late_s for estimate in estimates):
        estimates = [*_maybe_on_time(estimates), *estimates]
    log_part = LogPart(log, scored_rows & _known_around(log, estimates), model)
    num_parts = max(cut_chunks(log, log_part.scored_rows, model).row.shape[1] // MAX_CHUNKS, 1)
    estimate = _chosen(log_part._replace(num_parts=num_parts), estimates)
    is_late = estimate.late_s > max(MIN_LATENCY_S, STANDARD_ERRORS * estimate.sigma_s)
    estimate = estimate if is_late else MotionEstimate(estimate.motion)
    return estimate._replace(is_sure=motion is not None)


def _apparent_estimates(
    motions: Sequence[Motion], offset_s: float, sigma_s: float, half_s: float
) -> list[MotionEstimate]:
    """Return each motion with the lateness that a correlation shows under it, 0 if it is small.

    Args:
        motions: the motions.
        offset_s: lateness of the poses under continuous motion.
        sigma_s: standard error of ``offset_s``.
        half_s: half of the log's usual step.
    """
    min_offset_s = max(ON_TIME_S, min(STANDARD_ERRORS * sigma_s, UNCERTAIN_S))
    estimates = []
    for motion in motions:
        late_s = offset_s if motion is Motion.CONTINUOUS else offset_s + half_s
        is_off = abs(late_s) > min_offset_s
        estimates.append(
            MotionEstimate(motion, late_s, sigma_s) if is_off else MotionEstimate(motion)
        )
    return estimates


def _maybe_on_time(estimates: Sequence[MotionEstimate]) -> list[MotionEstimate]:
    """Return the motions whose lateness is within its standard errors, with poses on time.

    ``UNCERTAIN_S`` bounds what counts as on time, so a short log may seem off by less than its
    standard errors under every motion. Without these trials all would pay for late poses, and
    chance would decide: a drone on time was once taken for a simulator's step with late poses. In
    42 such logs of 20 s (benchmarks.hidden, seeds 71 and 81), 18 of them with late poses, they
    changed two latenesses of 0.7 ms, which became 0, and exchanged one wrong step for another.
    """
    return [
        MotionEstimate(estimate.motion)
        for estimate in estimates
        if abs(estimate.late_s) < STANDARD_ERRORS * estimate.sigma_s
    ]


def _known_around(log: FlightLog, estimates: Sequence[MotionEstimate]) -> np.ndarray:
    """Return the rows at which poses are known for each lateness and a few fit steps around it."""
    reach_s = ROUNDS * MAX_STEP_S + DIFFERENCE_S
    late_s = [estimate.late_s for estimate in estimates if estimate.late_s > 0.0]
    ends = (min(0.0, min(late_s) - reach_s), max(late_s) + reach_s) if late_s else (0.0,)
    return np.logical_and.reduce([read_poses(log, end_s)[1] for end_s in ends])


def _chosen(log_part: LogPart, estimates: Sequence[MotionEstimate]) -> MotionEstimate:
    """Return the likeliest estimate; those close to the best are fitted further."""
    first = _fit(log_part, estimates[0])
    trials = [first, *(_fit(log_part, motion_estimate, first) for motion_estimate in estimates[1:])]
    misfits = _misfits(trials)
    trials = [
        _fit_lateness(log_part, trial) if misfit < min(misfits) + NEAR else trial
        for trial, misfit in zip(trials, misfits, strict=True)
    ]
    misfits = _misfits(trials)
    for part in range(1, log_part.num_parts):
        costs = _costs(trials, misfits)
        kept = [index for index, cost in enumerate(costs) if cost < min(costs) + UNDECIDED]
        if len(kept) < 2:
            break
        other_part, trials = log_part._replace(part=part), [trials[index] for index in kept]
        refitted = [
            _fit_lateness(
                other_part, _fit(other_part, previous.motion_estimate, previous), rounds=1
            )
            for previous in trials
        ]
        misfits = list(np.array(misfits)[kept] + _misfits(refitted))
        trials = [_both(*pair) for pair in zip(trials, refitted, strict=True)]
    costs = _costs(trials, misfits)
    for trial, cost in zip(trials, costs, strict=True):
        if trial.motion_estimate.motion is Motion.CONTINUOUS and cost <= min(costs) + CLEAR:
            return trial.motion_estimate
    return trials[int(np.argmin(costs))].motion_estimate


def _both(first: Trial, second: Trial) -> Trial:
    """Return the second trial with the weighted mean of both latenesses."""
    first_s, sigma_s = first.motion_estimate.late_s, first.motion_estimate.sigma_s
    second_s, second_sigma_s = second.motion_estimate.late_s, second.motion_estimate.sigma_s
    if first_s <= 0.0:
        return second
    weights = np.array([sigma_s, second_sigma_s]) ** -2.0
    late_s = float(weights @ [first_s, second_s] / weights.sum())
    sigma_s = float(weights.sum() ** -0.5)
    return second._replace(
        motion_estimate=first.motion_estimate._replace(late_s=late_s, sigma_s=sigma_s)
    )


def choose_simulator_step(problem: Problem, vector: np.ndarray) -> Motion:
    """Return the motion with the least misfit of a fitted model; its own unless clearly worse.

    Before the search, an incomplete model may fit another simulator's step better than the true
    one. This happened on one of 18 plants (benchmarks.beyond, seed 43), and only there another
    motion was better afterwards.
    """

    def misfit(motion: Motion) -> float:
        moving = replace(problem, like=problem.like._replace(motion=motion))
        residuals = moving.residuals(vector[None])[0]
        noise = noises.fit_noise(problem.chunks, residuals, problem.noise)
        return noises.total_misfit(problem.chunks, residuals, noise) - CLEAR * (
            motion is problem.like.motion
        )

    return min(Motion, key=misfit)


def motion_of(log: FlightLog, model: ModelParameters) -> Motion:
    """Return continuous for a measured log, else the likeliest motion.

    Without gyro and attitude a log shows no turns, and the model's own motion is returned.

    Args:
        log: with poses as logged.
        model: where the search starts.
    """
    if (required := required_motion(log)) is not None:
        return required
    if "w" not in log and "q" not in log:
        return model.motion
    if (shown := motion_of_sensors(log)) is not None:
        return shown
    with jax.enable_x64(True):
        return estimate_motion(log, model, np.ones(len(log), bool)).motion
