"""How the viewer opens: the course, a view that follows the drone, the plots, what happened when."""

from collections.abc import Sequence

import numpy as np
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TextLogColumnKind

from flytrack_env.state import Action
from flytrack_env.viz_rerun.entities import Entities
from flytrack_env.viz_rerun.flights import ShownFlight

BEHIND_M = (-2.5, 0.0, 1.2)
SMALLEST_M = 4.0  # of what a view of the course shows
ANGLES = {f"{angle} angle [deg]": (f"orientation/{angle}",) for angle in ("roll", "pitch", "yaw")}
KEYS = ("speed [m/s]", "roll stick", "force left open [m/s²]")  # plots whose legends serve the others
# Title of each plot, and the lines in it, or the folder of them.
PLOTS = {
    "speed [m/s]": ("speed",),
    "angular speed [rad/s]": ("angular_speed",),
    **{f"{stick} stick": (f"action/{stick}", f"applied/{stick}") for stick in Action._fields},
    "battery [V]": ("battery",),
    "distance to the next gate [m]": ("gate_distance",),
    "force left open [m/s²]": ("residual/**",),
}


def _around(flights: Sequence[ShownFlight]) -> rrb.EyeControls3D:
    """Return an eye that sees all paths, from behind and above."""
    positions = np.concatenate([flight.positions for flight in flights])
    low, high = positions.min(axis=0), positions.max(axis=0)
    middle, size = 0.5 * (low + high), max(float(np.linalg.norm(high - low)), SMALLEST_M)
    position = middle + size * np.array([-0.55, -0.35, 0.5])
    return rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=position, look_target=middle)


def _following(flight: ShownFlight, entities: Entities) -> rrb.Spatial3DView:
    """Return a view of the course from behind a drone: the world in a frame that flies along."""
    eye = rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=BEHIND_M, look_target=(0.0, 0.0, 0.0))
    return rrb.Spatial3DView(
        origin=f"/{entities.chase}",
        contents="/world/**",
        name=f"follow {flight.name}",
        eye_controls=eye,
        line_grid=False,
    )


def _plot(title: str, lines: Sequence[str], entities: Sequence[Entities]) -> rrb.TimeSeriesView:
    contents = [f"/{own.plots}/{line}" for own in entities for line in lines]
    # A legend hides a third of a small plot.
    legend = rrb.PlotLegend(rrb.Corner2D.RightTop, visible=title in KEYS)
    return rrb.TimeSeriesView(origin="/", contents=contents, name=title, plot_legend=legend)


def _plots(entities: Sequence[Entities], paths: set[str]) -> rrb.Grid:
    """Return a view for every plot that has lines; the angles share a place."""
    views: list[rrb.View | rrb.Container] = []
    for title, lines in PLOTS.items():
        if any(path.startswith(tuple(line.removesuffix("**") for line in lines)) for path in paths):
            views.append(_plot(title, lines, entities))
    return rrb.Grid(*views, rrb.Tabs(*(_plot(*angle, entities) for angle in ANGLES.items())), grid_columns=2)


def make_blueprint(
    flights: Sequence[ShownFlight], entities: Sequence[Entities], paths: set[str]
) -> rrb.Blueprint:
    """Return the layout of a recording; paths: the lines that its plots have, below that of the plots."""
    body = rrb.TextLogColumns(text_log_columns=[TextLogColumn(TextLogColumnKind.Body)])
    events = rrb.TextLogView(origin="/", contents="/events/**", name="what happened", columns=body)
    about = rrb.TextDocumentView(origin="/about", name="flights")
    follow = [_following(flight, own) for flight, own in zip(flights, entities, strict=True)]
    left = rrb.Vertical(
        rrb.Spatial3DView(origin="/world", name="course", eye_controls=_around(flights)),
        rrb.Tabs(*follow) if len(follow) > 1 else follow[0],
        rrb.Horizontal(about, events),
        row_shares=[4.0, 4.0, 2.0],
    )
    return rrb.Blueprint(
        rrb.Horizontal(left, _plots(entities, paths), column_shares=[1.0, 1.0]),
        rrb.TimePanel(state="collapsed", timeline="sim_time", play_state="playing", loop_mode="all"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )
