"""Plausibility of a log as a flight: enough data, columns that move, conventions that agree."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from flytrack_env import motors
from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.check import after_rate_curve, check_log, problems_of
from flytrack_sysid.kinematics import GRAVITY, cut_windows
from flytrack_sysid.log import CHANNELS, FlightLog, LogError

WINDOW_S = 1.0
STILL = 1e-6  # in any unit: a smaller change counts as none
MIN_ROWS = 100
MIN_S = 2.0
MAX_STEP_S = 0.5  # no log of a drone is as slow as 2 Hz
PER_S = {"ms": 1e3, "us": 1e6, "ns": 1e9}
MIN_TURN = 0.3  # rad within a second: more than the bias of a gyroscope at rest integrates to
MAX_BIAS = 2.5  # m/s^2, of an accelerometer in flight, vibration included
DIAGNOSED = ("delay", "held", "repeated")  # kinds of changes that a diagnosis allows for


def _columns(*channels: str) -> str:
    return ", ".join(column for channel in channels for column in CHANNELS[channel])


def _with_time_in_s(log: FlightLog) -> tuple[FlightLog, list[str]]:
    """Return the log with its time in s, and the problem if it was in another unit."""
    steps = np.diff(log.time)[~log.is_start()[1:]]
    step = np.median(steps) if len(steps) else 0.0
    if step < MAX_STEP_S:
        return log, []
    likely = (unit for unit, per_second in PER_S.items() if step < MAX_STEP_S * per_second)
    unit = next(likely, "ns")
    problem = f"t: found a median step of {step:.4g}, expected less than {MAX_STEP_S:g} s"
    return replace(log, time=log.time / PER_S[unit]), [f"{problem}: this looks like {unit}"]


def _length(log: FlightLog) -> Iterator[str]:
    duration = np.diff(log.time)[~log.is_start()[1:]].sum()
    if len(log) < MIN_ROWS or duration < MIN_S:
        expected = f"expected at least {MIN_ROWS} rows and {MIN_S:g} s"
        yield (
            f"t: found {len(log)} rows and {duration:.3g} s, {expected}: too short to tell "
            "anything from"
        )


def _commands(log: FlightLog) -> Iterator[str]:
    if np.ptp(log["u"], axis=0).max() <= STILL:
        values = ", ".join(f"{value:g}" for value in log["u"][0])
        yield (
            f"{_columns('u')}: found {values} in every row, expected commands that move: they look "
            "stuck"
        )


def _motors(log: FlightLog) -> Iterator[str]:
    """Find a motor that stands still while others move."""
    if not log.has_motors:
        return
    spans = np.ptp(log["u"], axis=0)
    for name, span, first in zip(motors.NAMES, spans, log["u"][0], strict=True):
        if span <= STILL < spans.max():
            yield (
                f"u: motor {name}: found {first + 0.0:g} in every row while the others move, "
                "expected outputs of four motors: it is missing, or its column is another's"
            )


def _motion(log: FlightLog) -> Iterator[str]:
    measured = [name for name in ("p", "v", "a", "f", "q", "w") if name in log]
    moving = {name for name in ("u", *measured) if np.ptp(log[name], axis=0).max() > STILL}
    if measured and moving == {"u"}:
        problem = "found the same values in every row while the commands move"
        yield f"{_columns(*measured)}: {problem}: the sensors or their logging look stuck"


def _attitude(log: FlightLog) -> Iterator[str]:
    """Find an attitude that does not change although the body rates do not vanish."""
    if "q" not in log or "w" not in log:
        return
    windows = cut_windows(log, WINDOW_S)
    turn = np.linalg.norm(windows.mean_of(log, log["w"]), axis=1) * windows.durations
    if np.ptp(log["q"], axis=0).max() <= STILL and len(turn) and turn.max() > MIN_TURN:
        problem = (
            f"found the same in every row while {_columns('w')} turn by {turn.max():.2g} rad in a "
            "second"
        )
        yield f"{_columns('q')}: {problem}: the attitude looks stuck"


def _acceleration(log: FlightLog) -> Iterator[str]:
    """Compare the mean of ``a_z`` with the growth of ``v_z``."""
    if "a" not in log or "v" not in log:
        return
    windows = cut_windows(log, WINDOW_S)
    if len(windows.starts) == 0:
        return
    changes = windows.mean_rate(log["v"])
    offset = float(np.median((windows.mean_of(log, log["a"]) - changes)[:, 2]))
    if abs(offset - GRAVITY) <= MAX_BIAS:
        problem = f"found {offset:.3g} m/s^2 more than v_z changes by, expected 0 in hover"
        yield f"a_z: {problem}: gravity looks left in, as an accelerometer measures it"


def _conventions(log: FlightLog, model: ModelParameters | None) -> Iterator[str]:
    """Find channels that contradict each other, but for what a diagnosis names by itself."""
    check = check_log(after_rate_curve(log, model))
    kinds = {change.kind for one in check.explanations for change in one}
    if kinds - set(DIAGNOSED) or (check.contradicts and not kinds):
        yield from problems_of(check)


CHECKS = (_length, _commands, _motors, _motion, _attitude, _acceleration)


def find_problems(
    log: FlightLog, accept: bool = False, model: ModelParameters | None = None
) -> list[str]:
    """Return the problems of a log that no flight can have, a sentence each; empty if none.

    Each sentence names the source, the columns, what was found, and why it looks wrong. If the time
    is not in s, the other checks use the corrected time.

    Args:
        log: a flight log.
        accept: do not compare channels with each other.
        model: of the craft, whose rate curve is known; None if there is none.
    """
    log, problems = _with_time_in_s(log)
    problems = [*problems, *(problem for check in CHECKS for problem in check(log))]
    if not problems and not accept:
        problems = list(_conventions(log, model))
    return [f"{log.source}: {problem}" for problem in problems]


def check_plausible(
    log: FlightLog, accept: bool = False, model: ModelParameters | None = None
) -> None:
    """Raise LogError for a log that no flight can have; the message has a line for each problem.

    Arguments are those of ``find_problems``.
    """
    problems = find_problems(log, accept, model)
    if problems:
        raise LogError("\n".join(problems))
