"""What ``flytrack show`` does with its flags."""

from pathlib import Path

from flytrack.flags import Show
from flytrack_env.files import fresh_folder
from flytrack_env.pictures import (
    make_flight,
    read_flights,
    write_animation,
    write_camera_view,
    write_pictures,
)
from flytrack_env.references import (
    ghost_restarts,
    ghost_rollout,
    shipped_reference,
    shipped_references,
)
from flytrack_env.rollout import load_named_rollouts
from flytrack_env.tracks import load_track
from flytrack_env.viz_rerun.recording import write_recording
from flytrack_env.viz_rerun.trajectory import Trajectory

DEFAULT_OUT = Path("runs/show")
RECORDING = "flights.rrd"
GHOST_STEPS = 1200  # without rollouts


def run_show(flags: Show) -> None:
    """Write a recording of all flights, and pictures of each.

    Raises:
        ImportError, OSError, ValueError: what cannot be read, shown or written.
    """
    track = load_track(flags.track)
    rollouts = load_named_rollouts(flags.rollouts, flags.allow_pickle)
    recorded = [Trajectory(name, *rollout) for name, rollout in rollouts.items()]
    flights = read_flights(flags.rollouts, track, flags.allow_pickle)
    num_steps = max((len(one.states) for one in recorded), default=GHOST_STEPS)
    if flags.ghost or not recorded:
        references = shipped_references(track, (flags.ghost_model,))
        restarts = ghost_restarts(references, num_steps)
        ghost = ghost_rollout(references, num_steps)
        recorded.append(Trajectory("time-optimal", *ghost, restarts=restarts))
    optimal = (
        shipped_reference(track.name, "flying", flags.ghost_model) if flags.animation else None
    )
    folder = flags.out or fresh_folder(DEFAULT_OUT)
    folder.mkdir(parents=True, exist_ok=True)
    write_recording(folder / RECORDING, recorded, track, with_camera=flags.camera)
    paths = [folder / RECORDING, *write_pictures(flights, folder)]
    if optimal is not None:
        paths += [write_animation(flight, optimal, folder) for flight in flights]
    if flags.camera:
        shown = flights or [
            make_flight(one.name, one.states, one.actions, track) for one in recorded
        ]
        paths += [write_camera_view(flight, folder) for flight in shown]
    print(f"shown: {', '.join(one.name for one in recorded)}, {num_steps} steps on {track.name}")
    for path in paths:
        print(f"{path}: {path.stat().st_size} bytes")
