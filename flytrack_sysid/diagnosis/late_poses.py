"""Late poses as a cause: the correction of the log, its interval, and its gain."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flytrack_env.effects import BY_NAME, MocapLatency
from flytrack_sysid.diagnosis.motion_choice import STANDARD_ERRORS, MotionEstimate
from flytrack_sysid.diagnosis.result import (
    TWO_SIDED_95,
    Cause,
    Changed,
    Diagnosis,
    Estimated,
)
from flytrack_sysid.diagnosis.summary import classify
from flytrack_sysid.inference.chunks import Chunks
from flytrack_sysid.inference.lateness import get_latency
from flytrack_sysid.inference.problem import Problem, robust_square, vector_of

EFFECT = BY_NAME["mocap_latency"]
BOUNDS = EFFECT.ranges["latency_s"]


def chi2_gain(problem: Problem, as_logged: Chunks, vector: np.ndarray) -> float:
    """Return the gain of corrected over logged poses, in minus twice the log likelihood.

    Nothing is refitted.
    """
    counts = problem.counts & as_logged.counts

    def cost(variant: Problem) -> float:
        scored = replace(variant, chunks=variant.chunks._replace(counts=counts)).with_noise(
            problem.noise
        )
        return robust_square(scored.whitened_residuals(vector)[0])

    return cost(replace(problem.with_chunks(as_logged), late=None)) - cost(problem)


def with_late_poses(
    diagnosis: Diagnosis,
    motion_estimate: MotionEstimate,
    problems: Sequence[Problem],
    logged: Sequence[Chunks],
) -> Diagnosis:
    """Return a diagnosis of corrected poses with their lateness, as a cause if it matters.

    Args:
        diagnosis: of corrected poses.
        motion_estimate: with the lateness.
        problems: of the rows to learn from, and of the held-out rows.
        logged: the chunks of each problem, as logged.
    """
    before_s, late_s, sigma_s = (
        get_latency(diagnosis.nominal),
        min(motion_estimate.late_s, BOUNDS.high),
        motion_estimate.sigma_s,
    )
    if not late_s and not before_s:
        return diagnosis
    base = diagnosis.base.with_effects(MocapLatency(np.float32(before_s)))
    extended = diagnosis.extended.with_effects(MocapLatency(np.float32(late_s)))
    diagnosis = replace(diagnosis, base=base, extended=extended)
    name, unit = "mocap_latency.latency_s", BOUNDS.unit
    latency = Estimated.around(late_s, TWO_SIDED_95 * sigma_s, unit, BOUNDS.low)
    if abs(late_s - before_s) <= STANDARD_ERRORS * sigma_s:
        return diagnosis
    gains = [chi2_gain(*pair, vector_of(extended)) for pair in zip(problems, logged, strict=True)]
    size = float((late_s - before_s) / max(sigma_s, 1e-6)) ** 2
    cause = Cause(
        effect=EFFECT.name,
        equivalent=(),
        channel="attitude",
        parameters={"latency_s": latency},
        chi2_gain=gains[0],
        heldout_gain=gains[1],
        lambda_=size,
        lambda_sep=size,
        beyond=f"latency_s at least {late_s:.3g} s" if motion_estimate.late_s > BOUNDS.high else "",
    )
    changed = Changed(name, before_s, late_s, latency.ci95, unit, bool(cause.beyond))
    diagnosis = replace(diagnosis, changed=(*diagnosis.changed, changed))
    if abs(late_s - before_s) < EFFECT.notable["latency_s"]:
        return replace(diagnosis, negligible=(cause, *diagnosis.negligible))
    if cause.beyond:
        unexplained = replace(diagnosis.unexplained, flagged=True)
        diagnosis = replace(diagnosis, beyond=(cause, *diagnosis.beyond), unexplained=unexplained)
    else:
        diagnosis = replace(diagnosis, causes=(cause, *diagnosis.causes))
    return replace(diagnosis, verdict=classify(diagnosis.causes, diagnosis.unexplained))
