"""Flights as Rerun recordings; needs the extra ``flytrack[viz]``.

The entities, all in the world frame unless said otherwise:

==========================================  ======  ===================================================
entity                                      when    what
==========================================  ======  ===================================================
world                                       static  ViewCoordinates.RIGHT_HAND_Z_UP
world/gates/{centre,outer,inner,direction}  static  one instance per gate, in the order of the rows
world/bounds                                static  the box that must not be left, if the track has one
world/drone                                 step    pose: translation in m, rotation body to world
world/chase                                 step    frame at the drone, level, x in the direction of flight
world/drone/{motors,arms,camera}            static  body frame; moves with the pose above it
world/trajectory/{flown,recent}             step    the path so far: finished blocks, and the rest
world/passes, world/laps                    pass    where gates were passed so far; the last lap's time
world/residual/MODEL                        step    force that a model does not explain, 0.1 m for 1 m/s^2
plots/{speed,angular_speed,battery}         step    m/s, rad/s, V
plots/gate_distance                         step    m, to the centre of the gate to fly next
plots/{action,applied}/{roll,...,thrust}    step    commanded and applied action, in [-1, 1]
plots/orientation/{roll,pitch,yaw}          step    deg, turned in the order yaw, pitch, roll
plots/residual/MODEL                        step    m/s^2, size of the force not explained
events                                      pass    gates passed, laps, why the flight ended
about                                       static  a table of the flights
==========================================  ======  ===================================================

Of several flights the first has these entities; others have ``world/flights/NAME/drone`` and so on,
``plots/flights/NAME/speed`` and so on, and ``events/flights/NAME``.
"""

from flytrack_env.extras import check_installed

check_installed("viz", "recordings", "rerun")

from flytrack_env.viz_rerun.recording import visualize_state_action_sequence, write_recording
from flytrack_env.viz_rerun.serving import ServeError, serve
from flytrack_env.viz_rerun.trajectory import Trajectory

__all__ = [
    "ServeError",
    "Trajectory",
    "serve",
    "visualize_state_action_sequence",
    "write_recording",
]
