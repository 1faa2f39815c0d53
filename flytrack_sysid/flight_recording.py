"""Writing the recording of a log, where that can be done; reads Rerun only then (extra ``flytrack[viz]``)."""

from collections.abc import Mapping
from pathlib import Path

from flytrack_env.dynamics import ModelParameters
from flytrack_sysid.diagnosis.traces import Traces
from flytrack_sysid.log import FlightLog


def write_flight_recording(
    path: Path, log: FlightLog, models: Mapping[str, ModelParameters], left: Traces | None = None
) -> str:
    """Write a log and what models make of it as a Rerun recording; return why not, "" if it was written.

    models, left: as of ``shown_log.flights_of``. Where nothing is written, a file of that name is removed:
    an earlier log's would pass for this one's.

    Raises:
        OSError: an earlier file that cannot be removed.
    """
    reason = _written(path, log, models, left)
    if reason:
        path.unlink(missing_ok=True)
    return reason


def _written(path: Path, log: FlightLog, models: Mapping[str, ModelParameters], left: Traces | None) -> str:
    try:
        from flytrack_env.viz_rerun import write_recording
        from flytrack_sysid.shown_log import flights_of

        write_recording(path, flights_of(log, models, left), None)
    except (ImportError, ValueError) as error:  # Rerun is not installed; what cannot be shown or written
        return str(error)
    return ""
