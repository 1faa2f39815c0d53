"""Writing the recording of a log; Rerun is imported on the first call (``flytrack[viz]``)."""

from collections.abc import Mapping
from pathlib import Path

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.diagnosis.traces import Traces
from flytrack_sysid.log import FlightLog


def write_flight_recording(
    path: Path,
    log: FlightLog,
    models: Mapping[str, ModelParameters],
    residuals: Traces | None = None,
) -> str:
    """Write a log and models' flights as a Rerun recording; return the error, "" if written.

    If nothing is written, an existing file of that name is removed, because it would look like the
    recording of this log.

    Args:
        path: of the recording.
        log: the flight log.
        models: as for ``trajectories.measure_trajectories``.
        residuals: as for ``trajectories.measure_trajectories``.
    """
    try:
        from flytrack_env.viz_rerun import write_recording
        from flytrack_sysid.trajectories import measure_trajectories

        write_recording(path, measure_trajectories(log, models, residuals), None)
    except (
        ImportError,
        ValueError,
    ) as error:  # Rerun is not installed; something cannot be shown or written
        path.unlink(missing_ok=True)
        return str(error)
    return ""
