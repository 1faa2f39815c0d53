"""How the viewer opens: the course, a view that follows the drone, the plots, and the events."""

from collections.abc import Sequence

import numpy as np
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TextLogColumnKind

from flytrack_env.state import Action
from flytrack_env.viz_rerun.entities import Writer

BEHIND_M = (-2.5, 0.0, 1.2)  # of the drone, in its level frame
ABOVE = (-0.55, -0.35, 0.5)  # of the middle of the paths, in sizes of them
SMALLEST_M = 4.0  # of what a view of the course shows
ANGLES = {f"{angle} angle [deg]": (f"orientation/{angle}",) for angle in ("roll", "pitch", "yaw")}
FORCE = "force not explained [m/s²]"
KEYS = ("speed [m/s]", "roll stick", FORCE)  # plots whose legends serve the others
# Title of each plot, and the lines in it, or the folder of them.
PLOTS = {
    "speed [m/s]": ("speed",),
    "angular speed [rad/s]": ("angular_speed",),
    **{f"{stick} stick": (f"action/{stick}", f"applied/{stick}") for stick in Action._fields},
    "battery [V]": ("battery",),
    "distance to the next gate [m]": ("gate_distance",),
    FORCE: ("residual/**",),
}


def _view(name: str, origin: str, position: Sequence[float], target: Sequence[float]) -> rrb.Spatial3DView:
    """Return a view of the world in the frame of an entity, from a position and towards a target in it."""
    eye = rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=position, look_target=target)
    return rrb.Spatial3DView(origin=origin, contents="/world/**", name=name, eye_controls=eye)


def _plot(title: str, lines: Sequence[str], writers: Sequence[Writer]) -> rrb.TimeSeriesView:
    contents = [f"/{writer.plots}/{line}" for writer in writers for line in lines]
    # A legend hides a third of a small plot.
    legend = rrb.PlotLegend(rrb.Corner2D.RightTop, visible=title in KEYS)
    return rrb.TimeSeriesView(origin="/", contents=contents, name=title, plot_legend=legend)


def make_blueprint(writers: Sequence[Writer], paths: set[str]) -> rrb.Blueprint:
    """Return the layout of a recording; paths: of the lines that its plots have, below that of the plots."""
    has_line = {
        title: any(path.startswith(tuple(line.removesuffix("**") for line in lines)) for path in paths)
        for title, lines in PLOTS.items()
    }
    plots = [_plot(title, lines, writers) for title, lines in PLOTS.items() if has_line[title]]
    angles = rrb.Tabs(*(_plot(title, lines, writers) for title, lines in ANGLES.items()))
    body = rrb.TextLogColumns(text_log_columns=[TextLogColumn(TextLogColumnKind.Body)])
    positions = np.concatenate([writer.trajectory.positions for writer in writers])
    low, high = positions.min(axis=0), positions.max(axis=0)
    middle, size = 0.5 * (low + high), max(float(np.linalg.norm(high - low)), SMALLEST_M)
    chases = [
        _view(f"follow {writer.trajectory.name}", f"/{writer.world}/chase", BEHIND_M, (0.0, 0.0, 0.0))
        for writer in writers
    ]
    left = rrb.Vertical(
        _view("course", "/world", middle + size * np.array(ABOVE), middle),
        rrb.Tabs(*chases) if len(chases) > 1 else chases[0],
        rrb.Horizontal(
            rrb.TextDocumentView(origin="/about", name="flights"),
            rrb.TextLogView(origin="/", contents="/events/**", name="events", columns=body),
        ),
        row_shares=[4.0, 4.0, 2.0],
    )
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Grid(*plots, angles, grid_columns=2), column_shares=[1.0, 1.0]),
        rrb.TimePanel(state="collapsed", timeline="sim_time", play_state="playing", loop_mode="all"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )
