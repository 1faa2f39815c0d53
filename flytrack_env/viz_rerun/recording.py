"""Writing flights as one recording, whole or not at all."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr

from flytrack_env.files import write_atomically
from flytrack_env.flown_race import FlownRace
from flytrack_env.scene import FLIGHT_COLOURS
from flytrack_env.tracks import Track
from flytrack_env.viz_rerun.blueprint import KEY, make_blueprint
from flytrack_env.viz_rerun.entities import Writer, centres_of, log_course, plots_of
from flytrack_env.viz_rerun.trajectory import Pairs, Trajectory, checked, track_of_gates, trajectory_of_pairs

APP_ID = "flytrack"


def visualize_state_action_sequence(
    sequence: Pairs, gates: np.ndarray, recording_path: str, app_id: str = APP_ID
) -> None:
    """Write a flight as a Rerun recording, on the timelines ``step`` and ``sim_time`` (100 Hz).

    sequence: pairs of state (21,) and action (4,), one per step. Outside the pose, a number that is
    not finite is a gap in its plot. gates: (N, >=8) with id, x, y, z, qw, qx, qy, qz (to world),
    drawn in the handout's size, 2.7 m outside and 1.5 m inside, and each taken to be flown in the
    direction in which the flight first passes it.

    Raises:
        ValueError: no steps, wrong shapes, a pose that is not finite, a quaternion whose norm is
            not 1 within 1e-3, or a path that cannot be written, which leaves no file behind.
    """
    trajectory = checked(trajectory_of_pairs(sequence, "sequence"))
    write_recording(recording_path, [trajectory], track_of_gates(gates, trajectory.positions), app_id)


def write_recording(
    path: str | Path, flights: Sequence[Trajectory], track: Track | None, app_id: str = APP_ID
) -> None:
    """Write flights on one time line as a Rerun recording, under a temporary name that is then renamed.

    flights: at least one, of different names; the first has the entities of the handout, others their own
    below ``flights/NAME``. track: None shows no gates.

    Raises:
        ValueError: no flights, two of one name, a flight that cannot be shown (as for
            ``visualize_state_action_sequence``), or a path that cannot be written.
    """
    flights = [checked(flight) for flight in flights]
    names = [flight.name for flight in flights]
    if len(set(names)) != len(names) or not names:
        raise ValueError(f"flights: found names {names}, expected at least one, each once")
    content = _record(flights, track, app_id)
    try:
        write_atomically(path, content)
    except OSError as error:
        reason = f"found a path that cannot be written ({error}), expected a writable file name"
        raise ValueError(f"recording_path {path}: {reason}") from error


def _record(flights: Sequence[Trajectory], track: Track | None, app_id: str) -> bytes:
    """Return the content of a recording; Rerun's own writer would wait forever on a full disk."""
    recording = rr.RecordingStream(app_id)
    if not rr.is_enabled(recording):
        # A disabled stream ignores all that is logged and would leave an empty file.
        raise ValueError("environment variable RERUN: found it turned off, expected on or unset")
    models = [model for flight in flights for model in flight.residuals_w]
    names = dict.fromkeys([*(flight.name for flight in flights), *models])
    colours = {name: FLIGHT_COLOURS[place % len(FLIGHT_COLOURS)] for place, name in enumerate(names)}
    writers = [Writer(flight, place == 0, colours) for place, flight in enumerate(flights)]
    races = [flight.race(track) for flight in flights]
    plots = [plots_of(flight, race) for flight, race in zip(flights, races, strict=True)]
    # The first flight has all the entities of the handout, others only those with numbers.
    plots[1:] = [[plot for plot in own if np.isfinite(plot.values).any()] for own in plots[1:]]
    ends = [flight.reason_ended(track, race) for flight, race in zip(flights, races, strict=True)]
    memory = recording.memory_recording()
    recording.send_blueprint(
        make_blueprint(writers, {plot.path for own in plots for plot in own}, centres_of(track), len(colours))
    )
    log_course(recording, track)
    places = [(0.0, float(place)) for place in range(len(colours))]
    key = rr.Points2D(
        places, labels=list(colours), colors=list(colours.values()), radii=0.1, show_labels=True
    )
    recording.log(KEY, key, static=True, strict=True)
    about = rr.TextDocument(_describe(flights, races, ends), media_type=rr.MediaType.MARKDOWN)
    recording.log("about", about, static=True, strict=True)
    for writer, own, race, ended in zip(writers, plots, races, ends, strict=True):
        label = "" if len(flights) == 1 else f"{writer.trajectory.name}: "
        writer.write(recording, own, label, _events(writer.trajectory, track, race, ended), race)
    return memory.drain_as_bytes()


def _events(
    flight: Trajectory, track: Track | None, race: FlownRace | None, ended: str
) -> list[tuple[int, str]]:
    """Return row and text of every gate passed, every lap, and the end."""
    events = []
    if track is not None and race is not None:
        for one in race.passes:
            lap = f"; lap {one.lap}: {one.lap_time_s:.3f} s" if one.lap else ""
            gate = track.gates[one.gate].id
            events.append((one.row, f"{flight.name}: passed gate {gate} at {one.time_s:.3f} s{lap}"))
    return [*events, (len(flight.states) - 1, f"{flight.name}: ended: {ended}")]


def _describe(flights: Sequence[Trajectory], races: Sequence[FlownRace | None], ends: Sequence[str]) -> str:
    """Return a table of the flights, Markdown."""
    lines = ["| flight | laps (s) | time (s) | gates | ended |", "|---|---|---|---|---|"]
    for flight, race, ended in zip(flights, races, ends, strict=True):
        passes = () if race is None else race.passes
        laps = ", ".join(f"{each.lap_time_s:.3f}" for each in passes if each.lap) or "-"
        duration_s = flight.time_ns[-1] * 1e-9
        lines.append(f"| {flight.name} | {laps} | {duration_s:.2f} | {len(passes)} | {ended} |")
    return "\n".join(lines)
