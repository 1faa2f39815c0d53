"""Writing flights as one recording, whole or not at all; and how the viewer opens it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TextLogColumnKind

from flytrack_env.files import write_atomically
from flytrack_env.scene import FLIGHT_COLOURS
from flytrack_env.state import ACTION_SIZE, STATE_SIZE, Action
from flytrack_env.tracks import Track
from flytrack_env.viz_rerun.entities import CORNERS, MASK, Writer, centres_of, log_course, log_once
from flytrack_env.viz_rerun.trajectory import Trajectory, checked, track_of_gates

APP_ID = "flytrack_viz"

# How the viewer opens.
BEHIND_M = (-2.5, 0.0, 1.2)  # of the drone, in its level frame
BESIDE, ALONG, ABOVE = 0.5, 0.12, 0.36  # of the middle of paths and gates, in sizes of them
MIN_VIEW_M = 4.0  # of what a view of the course shows
ANGLES = {f"{angle} angle [deg]": (f"orientation/{angle}",) for angle in ("roll", "pitch", "yaw")}
FORCE = "force not explained [m/s²]"
KEY = "key"  # entity of the colours' names
# Title of each plot, and the lines in it, or the folder of them.
PLOTS = {
    "speed [m/s]": ("speed",),
    "angular speed [rad/s]": ("angular_speed",),
    **{
        f"{stick} stick (dim: commanded)": (f"action/{stick}", f"applied/{stick}")
        for stick in Action._fields
    },
    "battery [V]": ("battery",),
    "distance to the next gate [m]": ("gate_distance",),
    FORCE: ("residual/**",),
}


def visualize_state_action_sequence(
    sequence: Sequence[tuple[np.ndarray, np.ndarray]],
    gates: np.ndarray,
    recording_path: str = "rollout.rrd",
    app_id: str = APP_ID,
) -> None:
    """Write a flight as a Rerun recording, on the timelines ``step`` and ``sim_time`` (100 Hz).

    Outside the pose, a number that is not finite is a gap in its plot.

    Args:
        sequence: pairs of state (21,) and action (4,), one per step.
        gates: (N, >=8) with id, x, y, z, qw, qx, qy, qz (to world), drawn in the handout's size,
            2.7 m outside and 1.5 m inside, and each taken to be flown in the direction in which the
            flight first passes it.

    Raises:
        ValueError: no steps, wrong shapes, a pose that is not finite, a quaternion whose norm is
            not 1 within 1e-3, or a path that cannot be written, which leaves no file behind.
    """
    try:
        states, actions = (np.array(part, float) for part in zip(*sequence, strict=True))
    except (TypeError, ValueError) as error:
        expected = f"(x ({STATE_SIZE},), u ({ACTION_SIZE},))"
        raise ValueError(
            f"sequence: found no pairs of numbers ({error}), expected {expected}"
        ) from error
    trajectory = checked(Trajectory("sequence", states, actions))
    write_recording(
        recording_path, [trajectory], track_of_gates(gates, trajectory.positions), app_id
    )


def write_recording(
    path: str | Path,
    flights: Sequence[Trajectory],
    track: Track | None,
    app_id: str = APP_ID,
    with_camera: bool = False,
) -> None:
    """Write flights on one time line as a Rerun recording.

    The file has a temporary name until it is complete.

    Args:
        flights: at least one, of different names; the first has the entities of the handout, others
            their own below ``flights/NAME``.
        track: None shows no gates.
        with_camera: whether what the cameras of the flights see is recorded, of flights at 100 Hz
            on a track with gates.

    Raises:
        ValueError: no flights, two of one name, a flight that cannot be shown (as for
            ``visualize_state_action_sequence``), or a path that cannot be written.
    """
    flights = [checked(flight) for flight in flights]
    names = [flight.name for flight in flights]
    if len(set(names)) != len(names) or not names:
        raise ValueError(f"flights: found names {names}, expected at least one, each once")
    content = _record(flights, track, app_id, with_camera)
    try:
        write_atomically(path, content)
    except OSError as error:
        reason = f"found a path that cannot be written ({error}), expected a writable file name"
        raise ValueError(f"recording_path {path}: {reason}") from error


def _record(
    flights: Sequence[Trajectory], track: Track | None, app_id: str, with_camera: bool
) -> bytes:
    """Return the content of a recording; Rerun's own writer would wait forever on a full disk."""
    recording = rr.RecordingStream(app_id)
    if not rr.is_enabled(recording):
        # A disabled stream ignores all that is logged and would leave an empty file.
        raise ValueError("environment variable RERUN: found it turned off, expected on or unset")
    models = [model for flight in flights for model in flight.residuals_w]
    names = dict.fromkeys([*(flight.name for flight in flights), *models])
    colours = {
        name: FLIGHT_COLOURS[index % len(FLIGHT_COLOURS)] for index, name in enumerate(names)
    }
    writers = [
        Writer(recording, flight, track, index == 0, colours)
        for index, flight in enumerate(flights)
    ]
    memory = recording.memory_recording()
    recording.send_blueprint(make_blueprint(writers, centres_of(track), len(colours), with_camera))
    log_course(recording, track)
    points = [(0.0, float(index)) for index in range(len(colours))]
    key = rr.Points2D(
        points, labels=list(colours), colors=list(colours.values()), radii=0.1, show_labels=True
    )
    log_once(recording, KEY, key)
    about = rr.TextDocument(_describe(writers), media_type=rr.MediaType.MARKDOWN)
    log_once(recording, "about", about)
    for writer in writers:
        writer.write("" if len(flights) == 1 else f"{writer.trajectory.name}: ")
        if with_camera:
            writer.send_camera()
    return memory.drain_as_bytes()


def _describe(writers: Sequence[Writer]) -> str:
    """Return a table of the flights, Markdown."""
    lines = ["| flight | laps (s) | time (s) | gates | ended |", "|---|---|---|---|---|"]
    for writer in writers:
        flight, passes = writer.trajectory, () if writer.race is None else writer.race.passes
        laps = ", ".join(f"{each.lap_time_s:.3f}" for each in passes if each.lap) or "-"
        duration_s = flight.time_ns[-1] * 1e-9
        lines.append(
            f"| {flight.name} | {laps} | {duration_s:.2f} | {len(passes)} | {writer.ended} |"
        )
    return "\n".join(lines)


def _view(
    name: str, origin: str, position: Sequence[float], target: Sequence[float]
) -> rrb.Spatial3DView:
    """Return a view of the world in an entity's frame, from a position towards a target."""
    eye = rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=position, look_target=target)
    contents = ["+ /world/**", "- /world/bounds"]  # around a course, the bounds are mostly empty
    return rrb.Spatial3DView(origin=origin, contents=contents, name=name, eye_controls=eye)


def _plot(title: str, lines: Sequence[str], writers: Sequence[Writer]) -> rrb.TimeSeriesView:
    contents = [f"/{writer.plots}/{line}" for writer in writers for line in lines]
    legend = rrb.PlotLegend(visible=False)  # it would hide a third of a small plot
    return rrb.TimeSeriesView(origin="/", contents=contents, name=title, plot_legend=legend)


def make_blueprint(
    writers: Sequence[Writer], gates_w: np.ndarray, num_colours: int, with_camera: bool = False
) -> rrb.Blueprint:
    """Return the layout of a recording.

    Args:
        gates_w: centres (num_gates, 3), world, m.
        num_colours: rows of the key.
        with_camera: whether there are views of the first flight's camera.
    """
    paths = {plot.path for writer in writers for plot in writer.lines}
    plots = []
    for title, lines in PLOTS.items():
        prefixes = tuple(line.removesuffix("**") for line in lines)
        if any(path.startswith(prefixes) for path in paths):
            plots.append(_plot(title, lines, writers))
    angles = rrb.Tabs(*(_plot(title, lines, writers) for title, lines in ANGLES.items()))
    body = rrb.TextLogColumns(text_log_columns=[TextLogColumn(TextLogColumnKind.Body)])
    positions = np.concatenate([gates_w, *(writer.trajectory.positions for writer in writers)])
    low, high = positions.min(axis=0), positions.max(axis=0)
    middle, size = 0.5 * (low + high), max(float(np.linalg.norm(high - low)), MIN_VIEW_M)
    # From the broad side.
    beside = (
        [BESIDE, ALONG] if np.ptp(positions[:, 1]) > np.ptp(positions[:, 0]) else [ALONG, -BESIDE]
    )
    eye_w = middle + size * np.array([*beside, ABOVE])
    chases: list[Any] = [
        _view(
            f"follow {writer.trajectory.name}", f"/{writer.world}/chase", BEHIND_M, (0.0, 0.0, 0.0)
        )
        for writer in writers
    ]
    if with_camera:
        origins = (f"/{writers[0].world}/drone/{name}" for name in (CORNERS, MASK))
        chases += [rrb.Spatial2DView(origin=one, name=one.rpartition("/")[2]) for one in origins]
    left = rrb.Vertical(
        _view("course", "/world", eye_w, middle),
        (rrb.Horizontal if with_camera else rrb.Tabs)(*chases) if len(chases) > 1 else chases[0],
        rrb.Horizontal(
            rrb.TextDocumentView(origin="/about", name="flights"),
            rrb.TextLogView(origin="/", contents="/events/**", name="events", columns=body),
            column_shares=[4.0, 3.0],
        ),
        row_shares=[4.0, 4.0, 2.0],
    )
    rows = rrb.VisualBounds2D(x_range=[-1.0, 1.0], y_range=[-1.0, num_colours])
    key = rrb.Spatial2DView(origin=f"/{KEY}", name="colours", visual_bounds=rows)
    return rrb.Blueprint(
        rrb.Horizontal(
            left, rrb.Grid(*plots, angles, key, grid_columns=2), column_shares=[1.0, 1.0]
        ),
        rrb.TimePanel(
            state="collapsed", timeline="sim_time", play_state="playing", loop_mode="all"
        ),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )
