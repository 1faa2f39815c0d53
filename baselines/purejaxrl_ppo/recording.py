"""Flights as Rerun recordings; Rerun is imported when one is written."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from baselines.purejaxrl_ppo.flights import Rollout
from flytrack_env.references import References, ghost_rollout
from flytrack_env.tracks import Track

CANNOT_RECORD = "found no rerun-sdk, or RERUN turned off; expected pip install 'flytrack[viz]', RERUN unset"


def can_record() -> bool:
    """Return whether Rerun is installed, and not turned off by its environment variable."""
    if find_spec("rerun") is None:
        return False
    import rerun

    return rerun.is_enabled(rerun.RecordingStream("flytrack_probe"))


def record_flights(
    path: Path,
    flights: Mapping[str, Rollout],
    track: Track,
    num_laps: int | None = None,
    references: References | None = None,
) -> None:
    """Write flights by name on one timeline as a Rerun recording; the first is in the foreground.

    num_laps: laps to complete, if limited. references: the time-optimal flights of the track, shown as ghost.

    Raises:
        ImportError: Rerun is not installed; the message says how to install it.
        ValueError: a path that cannot be written.
    """
    from flytrack_env.viz_rerun import Trajectory, write_recording

    shown = []
    for name, flight in flights.items():
        is_flying = np.asarray(flight.is_flying)
        states, actions = (np.asarray(part)[is_flying] for part in (flight.states, flight.actions))
        ended = flight.end_reason(num_laps).replace("_", " ")
        shown.append(Trajectory(name, states, actions, ended=ended))
    if references is not None:
        longest = max(len(one.states) for one in shown)
        shown.append(Trajectory("time-optimal", *ghost_rollout(references, longest)))
    write_recording(path, shown, track)
