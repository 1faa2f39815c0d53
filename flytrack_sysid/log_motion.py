"""The motion within a step with which a log is replayed; a measured log is continuous.

The likelihoods of the two discrete integrators and of continuous motion differ by less than the
residuals of an incomplete model, so on measured logs they choose a simulator's step
(docs/diagnosis.md). Drones move continuously, so a choice remains only for logs that are not
measured.
"""

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import check_motors, takes_motors
from flytrack_env.motion import Motion
from flytrack_sysid.log import MEASURED, FlightLog, LogError

# Two flights of one craft agreed in 2 of 7 values (docs/results/motors.md).
DOUBTFUL_MOTORS = (
    "commands are the outputs of motors: where a measured flight hardly turns, inertia and lags "
    "may come out several times wrong, with too narrow intervals; trust what more flights show"
)
SAME_MASS = 1e-3  # relative: models hold float32, and people write three digits
HOW_TO_MARK = f"a column {MEASURED!r} says it: 1 for a real drone, 0 for a simulator"


def required_motion(log: FlightLog, requested: Motion | None = None) -> Motion | None:
    """Return the motion to replay a log with; None if neither requested nor measured.

    A requested motion has precedence; a measured log is continuous.
    """
    if requested is not None:
        return requested
    return Motion.CONTINUOUS if log.origin == "measured" else None


def motion_notes(
    log: FlightLog, model: ModelParameters | None, requested: Motion | None, otherwise: str
) -> list[str]:
    """Return what to doubt: where log, model and request contradict each other, a sentence each.

    Args:
        log: the replayed log.
        model: the model as given; None without one.
        requested: the requested motion; None without a request.
        otherwise: how the motion of a log that is not measured is chosen, for the note on a log
            that is not marked.
    """
    required, notes = required_motion(log, requested), []
    if log.origin == "measured" and log.has_motors:
        notes.append(DOUBTFUL_MOTORS)
    if log.origin == "measured" and required not in (None, Motion.CONTINUOUS):
        notes.append(
            f"motion: {required.value} was requested, but {log.source} is measured: drones move "
            "continuously"
        )
    if model is not None and log.stated_mass_kg is not None:
        mass_kg = float(model.m)
        if abs(mass_kg - log.stated_mass_kg) > SAME_MASS * mass_kg:
            notes.append(
                f"mass: {log.source} states {log.stated_mass_kg:g} kg, and the model "
                f"{mass_kg:g} kg, which is used: thrust and drag are those of that mass"
            )
    if model is not None and required is not None and model.motion is not required:
        why = "as requested" if requested is not None else f"since {log.source} is measured"
        notes.append(
            f"motion: replayed as {required.value}, {why}; the model says {model.motion.value}"
        )
    if log.origin is None and requested is None:
        notes.append(
            f"motion: {otherwise}, since {log.source} does not say whether a drone or a simulator "
            f"flew; {HOW_TO_MARK}; measured logs are replayed as continuous"
        )
    return notes


def check_commands(log: FlightLog, model: ModelParameters) -> None:
    """Raise LogError for a model that takes other commands than the log has, sticks or motors.

    Motors without a frame or beside effects of sticks are refused, too. The rates of a model that
    takes motors follow from torques, so that they have to be measured.
    """
    try:
        check_motors(model.effects)
    except ValueError as error:
        raise LogError(f"model: {error}") from error
    expects_motors = takes_motors(model.effects)
    if log.has_motors != expects_motors:
        found, expected = ("motors", "sticks") if log.has_motors else ("sticks", "motors")
        has = "without" if log.has_motors else "with"
        raise LogError(
            f"{log.source}: u: found commands of {found}, and a model that takes {expected} ({has} "
            "the effect motors); expected both of one kind"
        )
    if expects_motors and "w" not in log:
        raise LogError(
            f"{log.source}: w: missing, expected the gyro: motors turn a craft by torque"
        )


def check_same_origin(*logs: FlightLog) -> None:
    """Raise LogError if some of the logs are measured and others are not, or are not marked."""
    for log in logs[1:]:
        if log.origin != logs[0].origin:
            origins = f"{log.source} is {_shown(log)} and {logs[0].source} is {_shown(logs[0])}"
            raise LogError(f"{origins}; expected logs of one origin in one command; {HOW_TO_MARK}")


def _shown(log: FlightLog) -> str:
    return log.origin or "not marked"
