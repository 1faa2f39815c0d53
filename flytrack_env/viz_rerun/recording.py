"""Writing flights as one recording, whole or not at all."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rerun as rr

from flytrack_env.files import write_atomically
from flytrack_env.flown_race import FlownRace
from flytrack_env.tracks import Track
from flytrack_env.viz_rerun.blueprint import make_blueprint
from flytrack_env.viz_rerun.columns import (
    Plot,
    Sender,
    plots_of,
    send_chase,
    send_events,
    send_passes,
    send_plots,
    send_pose,
    send_residuals,
    send_trajectory,
)
from flytrack_env.viz_rerun.entities import Entities, entities_of
from flytrack_env.viz_rerun.flights import (
    ShownFlight,
    checked,
    end_of,
    flight_of_pairs,
    race_of,
    track_of_gates,
)
from flytrack_env.viz_rerun.scene import Colour, colour_of, log_course, log_drone

APP_ID = "flytrack_viz"


def visualize_state_action_sequence(
    sequence: list[tuple[np.ndarray, np.ndarray]],
    gates: np.ndarray,
    recording_path: str = "rollout.rrd",
    app_id: str = APP_ID,
) -> None:
    """Write a flight as a Rerun recording, with timelines ``step`` and ``sim_time`` (100 Hz).

    sequence: pairs of state (21,) and action (4,), one per step. Outside the pose, a number that is
    not finite is a gap in its plot. gates: (N, >=8) with id, x, y, z, qw, qx, qy, qz (to world),
    drawn in the handout's size, 2.7 m outside and 1.5 m inside, and each taken to be flown in the
    direction in which the flight first passes it.

    Raises:
        ValueError: no steps, wrong shapes, a pose that is not finite, a quaternion whose norm is
            not 1 within 1e-3, or a path that cannot be written, which leaves no file behind.
    """
    flight = checked(flight_of_pairs(sequence), "sequence")
    write_recording(recording_path, [flight], track_of_gates(gates, flight.positions), app_id)


def write_recording(
    path: str | Path, flights: Sequence[ShownFlight], track: Track | None, app_id: str = APP_ID
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
    colours = _colours(flights)
    is_alone = len(flights) == 1
    shown = [_show(flight, place == 0, colours, is_alone, track) for place, flight in enumerate(flights)]
    content = _record(app_id, shown, track)
    try:
        write_atomically(path, content)
    except OSError as error:
        reason = f"found a path that cannot be written ({error}), expected a writable file name"
        raise ValueError(f"recording_path {path}: {reason}") from error


class _Shown(NamedTuple):
    """A flight with all that is shown of it; label: before the names of its lines.

    colours: by the names of flights and models.
    """

    flight: ShownFlight
    entities: Entities
    race: FlownRace | None
    ended: str
    plots: list[Plot]
    colours: Mapping[str, Colour]
    label: str


def _colours(flights: Sequence[ShownFlight]) -> dict[str, Colour]:
    """Return the colours of flights, and of models whose forces they have: that of the flight of its name."""
    models = [model for flight in flights for model in flight.residuals_w]
    names = dict.fromkeys([*(flight.name for flight in flights), *models])
    return {name: colour_of(place) for place, name in enumerate(names)}


def _show(
    flight: ShownFlight, is_first: bool, colours: Mapping[str, Colour], is_alone: bool, track: Track | None
) -> _Shown:
    race = race_of(flight, track)
    plots = plots_of(flight, race)
    if not is_first:  # the first one has the entities of the handout
        plots = [plot for plot in plots if np.isfinite(plot.values).any()]
    return _Shown(
        flight=flight,
        entities=entities_of(flight.name, is_first),
        race=race,
        ended=end_of(flight, track, race),
        plots=plots,
        colours=colours,
        label="" if is_alone else f"{flight.name}: ",
    )


def _record(app_id: str, shown: Sequence[_Shown], track: Track | None) -> bytes:
    """Return the content of a recording.

    Not written by Rerun itself, which waits forever on a disk that is full.
    """
    recording = rr.RecordingStream(app_id)
    if not rr.is_enabled(recording):
        # A disabled stream ignores everything it is told and would leave an empty file.
        raise ValueError("environment variable RERUN: found it turned off, expected on or unset")
    lines = {plot.path for one in shown for plot in one.plots}
    blueprint = make_blueprint([one.flight for one in shown], [one.entities for one in shown], lines)
    memory = recording.memory_recording()
    recording.send_blueprint(blueprint)
    log_course(recording, track)
    about = rr.TextDocument(_describe(shown), media_type=rr.MediaType.MARKDOWN)
    recording.log("about", about, static=True, strict=True)
    for one in shown:
        _send(recording, one, track)
    return memory.drain_as_bytes()


def _send(recording: rr.RecordingStream, shown: _Shown, track: Track | None) -> None:
    """Send all of one flight."""
    sender, entities = Sender(recording, shown.flight), shown.entities
    log_drone(recording, entities, shown.colours[shown.flight.name])
    send_pose(sender, entities.drone)
    send_chase(sender, entities.chase)
    send_trajectory(sender, entities.trajectory)
    send_plots(sender, entities.plots, shown.plots, shown.label, shown.colours)
    send_residuals(sender, entities, shown.colours)
    send_events(sender, entities, track, shown.race, shown.ended)
    if shown.race is not None:
        send_passes(sender, entities, shown.race)


def _describe(shown: Sequence[_Shown]) -> str:
    """Return a table of the flights, Markdown."""
    lines = ["| flight | ended | time (s) | gates | laps (s) |", "|---|---|---|---|---|"]
    for one in shown:
        passes = () if one.race is None else one.race.passes
        laps = ", ".join(f"{each.lap_time_s:.3f}" for each in passes if each.lap) or "-"
        lasts_s = one.flight.time_ns[-1] * 1e-9
        lines.append(f"| {one.flight.name} | {one.ended} | {lasts_s:.2f} | {len(passes)} | {laps} |")
    return "\n".join(lines)
