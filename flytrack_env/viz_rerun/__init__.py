"""Flights as Rerun recordings; needs the extra ``flytrack[viz]``.

``docs/recordings.md`` lists the entities. The first flight has those of the handout, others their
own: ``world/flights/NAME/drone`` and so on, ``plots/flights/NAME/speed`` and so on,
``events/flights/NAME``.
"""

from flytrack_env.extras import check_installed

check_installed("viz", "recordings", "rerun")

from flytrack_env.viz_rerun.recording import visualize_state_action_sequence, write_recording
from flytrack_env.viz_rerun.trajectory import Trajectory

__all__ = ["Trajectory", "visualize_state_action_sequence", "write_recording"]
