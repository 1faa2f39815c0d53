"""Late poses as a cause: by how much the log was corrected, the interval, and what it gains."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flytrack_env.effects import BY_NAME, MocapLatency
from flytrack_sysid.diagnosis.chunks import Chunks
from flytrack_sysid.diagnosis.lateness import latency_of
from flytrack_sysid.diagnosis.motion_choice import STANDARD_ERRORS, MotionEstimate
from flytrack_sysid.diagnosis.problem import Problem, robust_square, vector_of
from flytrack_sysid.diagnosis.result import Cause, Changed, Diagnosis, Estimated
from flytrack_sysid.diagnosis.summary import TWO_SIDED_95, verdict_of

EFFECT = BY_NAME["mocap_latency"]
BOUNDS = EFFECT.ranges["latency_s"]


def gain_of(problem: Problem, as_logged: Chunks, vector: np.ndarray) -> float:
    """Return the gain of corrected over logged poses, in minus twice the log likelihood.

    Nothing is refitted.
    """
    counts = problem.counts & as_logged.counts

    def cost(one: Problem) -> float:
        scored = replace(one, chunks=one.chunks._replace(counts=counts)).with_noise(problem.noise)
        return robust_square(scored.whitened_residuals(vector)[0])

    return cost(replace(problem.with_chunks(as_logged), late=None)) - cost(problem)


def with_late_poses(
    found: Diagnosis,
    motion_estimate: MotionEstimate,
    problems: Sequence[Problem],
    logged: Sequence[Chunks],
) -> Diagnosis:
    """Return a diagnosis of corrected poses with how late they were, as a cause where it matters.

    problems: learnt from and judged by; logged: the chunks of each as logged.
    """
    before_s, late_s, sigma_s = (
        latency_of(found.nominal),
        min(motion_estimate.late_s, BOUNDS.high),
        motion_estimate.sigma_s,
    )
    if not late_s and not before_s:
        return found
    base = found.base.with_effects(MocapLatency(np.float32(before_s)))
    extended = found.extended.with_effects(MocapLatency(np.float32(late_s)))
    found = replace(found, base=base, extended=extended)
    name, unit = "mocap_latency.latency_s", BOUNDS.unit
    latency = Estimated.around(late_s, TWO_SIDED_95 * sigma_s, unit, BOUNDS.low)
    if abs(late_s - before_s) <= STANDARD_ERRORS * sigma_s:
        return found
    gains = [gain_of(*pair, vector_of(extended)) for pair in zip(problems, logged, strict=True)]
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
    found = replace(found, changed=(*found.changed, changed))
    if abs(late_s - before_s) < EFFECT.notable["latency_s"]:
        return replace(found, negligible=(cause, *found.negligible))
    if cause.beyond:
        rest = replace(found.unexplained, flagged=True)
        found = replace(found, beyond=(cause, *found.beyond), unexplained=rest)
    else:
        found = replace(found, causes=(cause, *found.causes))
    return replace(found, verdict=verdict_of(found.causes, found.unexplained))
