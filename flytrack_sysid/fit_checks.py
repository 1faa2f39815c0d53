"""What a fit refuses: logs that cannot determine a model, and answers that are none."""

import numpy as np
from scipy import signal

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.estimate import Estimate, FitError
from flytrack_sysid.log import CHANNELS, FlightLog, usual_step
from flytrack_sysid.parameters import (
    TAU_BOUNDS,
    TAUS,
    THRUST_COEFFS,
    bounds_of,
    names_of,
    neutral_value,
    to_vector,
    unit_of,
)

NEVER_MOVED = 1e-3  # of a stick's travel from -1 to 1
LEAST_ANSWER = 0.1  # correlation of a rate with its lagged command; chance gives less in a minute of noise
AT_BOUND = 1.01
AT_END = 1e-3  # of the range of an effect's parameter


def check_data(log: FlightLog, judged: np.ndarray, free: tuple[str, ...]) -> None:
    """Raise FitError where channels or motion are missing for what is to be estimated."""
    if not free:
        raise FitError("fixed: found every parameter, expected one to estimate at least")
    has_turns = "w" in log or "q" in log
    if not has_turns and any(name in free for name in TAUS[:3]):
        raise FitError(f"{log.source}: w and q are absent; the lags of the body rates need one of them")
    has_forces = "f" in log or ("q" in log and any(name in log for name in ("a", "v", "p")))
    if not has_forces and any(name in free for name in (TAUS[3], *THRUST_COEFFS)):
        raise FitError(
            f"{log.source}: thrust needs f, or q with one of a, v and p; found {', '.join(log.channels)}"
        )
    for axis, (column, tau) in enumerate(zip(CHANNELS["u"], TAUS, strict=True)):
        stick = log["u"][judged, axis]
        if tau in free and np.ptp(stick) < NEVER_MOVED:
            raise FitError(
                f"{log.source}: {column}: stuck at {stick[0]:.4g}; {tau} cannot be identified: move "
                f"it, or fix {tau}"
            )


def check_answer(log: FlightLog, start: ModelParameters) -> None:
    """Raise FitError where no body rate follows its command: motors off, on the ground, another log."""
    if "w" not in log:
        return
    answers = []
    for axis, keep in enumerate(np.exp(-usual_step(log)[0] / np.asarray(start.tau, float)[:3])):
        expected = signal.lfilter([1.0 - keep], [1.0, -keep], log["u"][:, axis])
        if np.ptp(expected) > NEVER_MOVED and np.ptp(log["w"][:, axis]) > 0.0:
            answers.append(abs(np.corrcoef(expected, log["w"][:, axis])[0, 1]))
    if answers and max(answers) < LEAST_ANSWER:
        raise FitError(
            f"{log.source}: w: found no body rate that follows its command (correlation at most "
            f"{max(answers):.2g}), expected a drone in flight; is it motionless?"
        )


def check_result(result: Estimate, log: FlightLog) -> None:
    """Raise FitError where the best model is none."""
    values = dict(zip(names_of(result.model), to_vector(result.model), strict=True))
    for name in TAUS:
        if name in result.free and not TAU_BOUNDS.low * AT_BOUND < values[name] < TAU_BOUNDS.high / AT_BOUND:
            raise FitError(
                f"{log.source}: {name}: the fit ended at {values[name]:.3g} s, expected {TAU_BOUNDS.low} to "
                f"{TAU_BOUNDS.high} s; does {CHANNELS['u'][TAUS.index(name)]} drive this drone?"
            )
    for name in (name for name in result.free if "." in name):
        low, high = bounds_of(name)
        ends = [end for end in (low, high) if end != neutral_value(name)]
        if np.isclose(values[name], ends, rtol=0.0, atol=AT_END * (high - low)).any():
            raise FitError(
                f"{log.source}: {name}: the fit ended at {values[name]:.3g} {unit_of(name)}, expected it "
                f"within {low:g} to {high:g}"
            )
    if "w" in result.noise:
        for axis, column in enumerate(CHANNELS["w"]):
            left, measured = result.noise["w"][axis], result.measured["w"][axis]
            if TAUS[axis] in result.free and left > AT_BOUND * measured:
                raise FitError(
                    f"{log.source}: {column}: the model leaves more ({left:.3g} rad/s rms) than was measured "
                    f"({measured:.3g}); do sign and order of {CHANNELS['u'][axis]} and {column} agree?"
                )
