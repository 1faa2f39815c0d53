"""How the viewer opens: the course, a view that follows the drone, the plots, and the events."""

from collections.abc import Sequence

import numpy as np
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TextLogColumnKind

from flytrack_env.state import Action
from flytrack_env.viz_rerun.entities import Writer

BEHIND_M = (-2.5, 0.0, 1.2)  # of the drone, in its level frame
BESIDE, ALONG, ABOVE = 0.5, 0.12, 0.36  # of the middle of paths and gates, in sizes of them
SMALLEST_M = 4.0  # of what a view of the course shows
ANGLES = {f"{angle} angle [deg]": (f"orientation/{angle}",) for angle in ("roll", "pitch", "yaw")}
FORCE = "force not explained [m/s²]"
KEY = "key"  # entity of the colours' names
# Title of each plot, and the lines in it, or the folder of them.
PLOTS = {
    "speed [m/s]": ("speed",),
    "angular speed [rad/s]": ("angular_speed",),
    **{
        f"{stick} stick (dim: commanded)": (f"action/{stick}", f"applied/{stick}") for stick in Action._fields
    },
    "battery [V]": ("battery",),
    "distance to the next gate [m]": ("gate_distance",),
    FORCE: ("residual/**",),
}


def _view(name: str, origin: str, position: Sequence[float], target: Sequence[float]) -> rrb.Spatial3DView:
    """Return a view of the world in the frame of an entity, from a position and towards a target in it."""
    eye = rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=position, look_target=target)
    contents = ["+ /world/**", "- /world/bounds"]  # around a course, the bounds are mostly empty
    return rrb.Spatial3DView(origin=origin, contents=contents, name=name, eye_controls=eye)


def _plot(title: str, lines: Sequence[str], writers: Sequence[Writer]) -> rrb.TimeSeriesView:
    contents = [f"/{writer.plots}/{line}" for writer in writers for line in lines]
    legend = rrb.PlotLegend(visible=False)  # it would hide a third of a small plot
    return rrb.TimeSeriesView(origin="/", contents=contents, name=title, plot_legend=legend)


def make_blueprint(
    writers: Sequence[Writer], paths: set[str], gates_w: np.ndarray, num_colours: int
) -> rrb.Blueprint:
    """Return the layout of a recording.

    paths: of the lines that its plots have, below that of the plots. gates_w: centres
    (num_gates, 3), world, m. num_colours: rows of the key.
    """
    has_line = {
        title: any(path.startswith(tuple(line.removesuffix("**") for line in lines)) for path in paths)
        for title, lines in PLOTS.items()
    }
    plots = [_plot(title, lines, writers) for title, lines in PLOTS.items() if has_line[title]]
    angles = rrb.Tabs(*(_plot(title, lines, writers) for title, lines in ANGLES.items()))
    body = rrb.TextLogColumns(text_log_columns=[TextLogColumn(TextLogColumnKind.Body)])
    positions = np.concatenate([gates_w, *(writer.trajectory.positions for writer in writers)])
    low, high = positions.min(axis=0), positions.max(axis=0)
    middle, size = 0.5 * (low + high), max(float(np.linalg.norm(high - low)), SMALLEST_M)
    # From the broad side.
    beside = [BESIDE, ALONG] if np.ptp(positions[:, 1]) > np.ptp(positions[:, 0]) else [ALONG, -BESIDE]
    eye_w = middle + size * np.array([*beside, ABOVE])
    chases = [
        _view(f"follow {writer.trajectory.name}", f"/{writer.world}/chase", BEHIND_M, (0.0, 0.0, 0.0))
        for writer in writers
    ]
    left = rrb.Vertical(
        _view("course", "/world", eye_w, middle),
        rrb.Tabs(*chases) if len(chases) > 1 else chases[0],
        rrb.Horizontal(
            rrb.TextDocumentView(origin="/about", name="flights"),
            rrb.TextLogView(origin="/", contents="/events/**", name="events", columns=body),
            column_shares=[3.0, 2.0],
        ),
        row_shares=[4.0, 4.0, 2.0],
    )
    rows = rrb.VisualBounds2D(x_range=[-1.0, 1.0], y_range=[-1.0, num_colours])
    key = rrb.Spatial2DView(origin=f"/{KEY}", name="colours", visual_bounds=rows)
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Grid(*plots, angles, key, grid_columns=2), column_shares=[1.0, 1.0]),
        rrb.TimePanel(state="collapsed", timeline="sim_time", play_state="playing", loop_mode="all"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )
