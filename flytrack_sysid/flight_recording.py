"""Writing the recording of a log; Rerun is imported only then (extra ``flytrack[viz]``)."""

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
    """Write a log and models' flights as a Rerun recording; return why not, "" if written.

    models, residuals: as for ``trajectories.trajectories_of``. Where nothing is written, a file of
    that name is removed: it would pass for this log's.
    """
    try:
        from flytrack_env.viz_rerun import write_recording
        from flytrack_sysid.trajectories import trajectories_of

        write_recording(path, trajectories_of(log, models, residuals), None)
    except (
        ImportError,
        ValueError,
    ) as error:  # Rerun is not installed; what cannot be shown or written
        path.unlink(missing_ok=True)
        return str(error)
    return ""
