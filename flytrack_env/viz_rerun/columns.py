"""What changes from step to step, sent as whole columns."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import rerun as rr

from flytrack_env.flown_race import FlownRace
from flytrack_env.state import APPLIED_ACTION, BATTERY, QUATERNION, RATES, VELOCITY, Action
from flytrack_env.tracks import Track
from flytrack_env.viz_rerun.entities import Entities
from flytrack_env.viz_rerun.flights import ShownFlight
from flytrack_env.viz_rerun.scene import ARROW_RADIUS, SCALED_FORCE, Colour

DIM = 0.6  # of what is commanded beside what is applied
THIN, THICK = 1.0, 2.0


class Plot(NamedTuple):
    """One line of a plot: its path below that of the plots, label, values (T,), the model it is of."""

    path: str
    label: str
    values: np.ndarray
    model: str = ""


class Sender:
    """Sends the columns of one flight."""

    def __init__(self, recording: rr.RecordingStream, flight: ShownFlight):
        self.recording, self.flight = recording, flight
        self.last_row = len(flight.states) - 1

    def send(self, entity: str, rows: np.ndarray, columns: rr.ComponentColumnList) -> None:
        """Send an entity's columns for these rows of the flight; what is after its end, at its end."""
        rows = np.minimum(rows, self.last_row)
        indexes = [
            rr.TimeColumn("step", sequence=rows),
            rr.TimeColumn("sim_time", duration=self.flight.time_ns[rows].astype("timedelta64[ns]")),
        ]
        self.recording.send_columns(entity, indexes, columns, strict=True)

    @property
    def all_rows(self) -> np.ndarray:
        """Every row of the flight, (T,)."""
        return np.arange(len(self.flight.states))


def send_pose(sender: Sender, entity: str) -> None:
    """Send the drone's pose; the body is logged once below it and moves along."""
    x_first = np.roll(sender.flight.states[:, QUATERNION], -1, axis=1)
    pose = rr.Transform3D.columns(translation=sender.flight.positions, quaternion=x_first)
    sender.send(entity, sender.all_rows, pose)


def send_chase(sender: Sender, entity: str) -> None:
    """Send a frame that flies along, level, x ahead: for an eye behind the drone."""
    states = sender.flight.states
    w, x, y, z = states[:, QUATERNION].T
    forward_w = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z)], axis=1)
    # Where it flies to; at rest, where it points.
    ahead_w = np.nan_to_num(states[:, VELOCITY][:, :2]) + forward_w
    half_yaw = 0.5 * np.arctan2(ahead_w[:, 1], ahead_w[:, 0])
    level = np.zeros_like(half_yaw)
    quaternions = np.stack([level, level, np.sin(half_yaw), np.cos(half_yaw)], axis=1)
    frame = rr.Transform3D.columns(translation=sender.flight.positions, quaternion=quaternions)
    sender.send(entity, sender.all_rows, frame)


def send_trajectory(sender: Sender, entity: str) -> None:
    """Send the path flown so far, for every step from 1 on.

    The whole path in every row would grow with T^2. So ``flown`` holds it up to the last multiple
    of ``block`` and changes once a block, and ``recent`` holds the rest; sqrt(T) balances the two.
    """
    positions, restarts = sender.flight.positions, sender.flight.restarts
    breaks = np.zeros(0, int) if restarts is None else np.flatnonzero(restarts)

    def strips(first: np.integer | int, last: np.integer) -> list[np.ndarray]:
        inside = breaks[(breaks > first) & (breaks <= last)]
        return np.split(positions[first : last + 1], inside - first)

    block = max(1, math.isqrt(len(positions)))
    steps = np.arange(1, len(positions))
    starts = (steps - 1) // block * block
    is_new_block = (starts == steps - 1) & (starts > 0)
    paths = {
        "recent": (steps, [strips(a, b) for a, b in zip(starts, steps, strict=True)]),
        "flown": (steps[is_new_block], [strips(0, a) for a in starts[is_new_block]]),
    }
    for name, (rows, found) in paths.items():
        if found:
            columns = rr.LineStrips3D.columns(strips=[strip for one in found for strip in one])
            sender.send(f"{entity}/{name}", rows, columns.partition([len(one) for one in found]))


def angles_deg(quaternions: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw of quaternions (T, 4), (T, 3) deg, in the order z, y, x, without jumps."""
    w, x, y, z = quaternions.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.degrees(np.stack([np.unwrap(roll), pitch, np.unwrap(yaw)], axis=1))


def plots_of(flight: ShownFlight, race: FlownRace | None) -> list[Plot]:
    """Return the lines of a flight's plots."""
    states = flight.states
    plots = [
        Plot("speed", "speed [m/s]", np.linalg.norm(states[:, VELOCITY], axis=1)),
        Plot("angular_speed", "angular speed [rad/s]", np.linalg.norm(states[:, RATES], axis=1)),
        Plot("battery", "battery [V]", states[:, BATTERY]),
    ]
    applied = states[:, APPLIED_ACTION]
    for column, name in enumerate(Action._fields):
        plots.append(Plot(f"action/{name}", f"{name} action", flight.actions[:, column]))
        plots.append(Plot(f"applied/{name}", f"{name} applied", applied[:, column]))
    angles = angles_deg(states[:, QUATERNION])
    for column, name in enumerate(("roll", "pitch", "yaw")):
        plots.append(Plot(f"orientation/{name}", f"{name} [deg]", angles[:, column]))
    if race is not None:
        plots.append(Plot("gate_distance", "distance to the next gate [m]", race.gate_distance_m))
    for name, forces_w in flight.residuals_w.items():
        size = np.linalg.norm(forces_w, axis=1)
        part = rr.escape_entity_path_part(name)
        plots.append(Plot(f"residual/{part}", f"force left open by {name} [m/s²]", size, name))
    return plots


def send_plots(
    sender: Sender, entity: str, plots: list[Plot], label: str, colours: Mapping[str, Colour]
) -> None:
    """Send the lines of plots, and their names once; label: before each name.

    colours: by the names of flights and models; a line of a model has that one's.
    """
    for plot in plots:
        is_command = plot.path.startswith("action/")
        own = colours[plot.model or sender.flight.name]
        shade = tuple(int(DIM**is_command * part) for part in own)
        width = THIN if is_command else THICK
        line = rr.SeriesLines(names=label + plot.label, colors=shade, widths=width)
        sender.recording.log(f"{entity}/{plot.path}", line, static=True, strict=True)
        sender.send(f"{entity}/{plot.path}", sender.all_rows, rr.Scalars.columns(scalars=plot.values))


def send_passes(sender: Sender, entities: Entities, race: FlownRace) -> None:
    """Send markers where gates were passed, all so far, and at the last lap's end its time."""
    if not race.passes:
        return
    # Of two gates passed in one step the later has both markers.
    last = {one.row: count for count, one in enumerate(race.passes, start=1)}
    places = [[one.pos_w for one in race.passes[:count]] for count in last.values()]
    points = rr.Points3D.columns(positions=np.concatenate(places))
    sender.send(entities.passes, np.array(list(last)), points.partition([len(one) for one in places]))
    laps = [one for one in race.passes if one.lap]
    if laps:
        labels = [f"lap {one.lap}: {one.lap_time_s:.3f} s" for one in laps]
        markers = rr.Points3D.columns(positions=[one.pos_w for one in laps], labels=labels)
        sender.send(entities.laps, np.array([one.row for one in laps]), markers)


def send_events(
    sender: Sender, entities: Entities, track: Track | None, race: FlownRace | None, ended: str
) -> None:
    """Send a line of text for every gate passed, every lap, and the end."""
    name, lines = sender.flight.name, []
    if track is not None and race is not None:
        for one in race.passes:
            lap = f"; lap {one.lap}: {one.lap_time_s:.3f} s" if one.lap else ""
            gate = track.gates[one.gate].id
            lines.append((one.row, f"{name}: passed gate {gate} at {one.time_s:.3f} s{lap}"))
    lines.append((sender.last_row, f"{name}: ended: {ended}"))
    rows, texts = zip(*lines, strict=True)
    columns = rr.TextLog.columns(text=texts, level=["INFO"] * len(texts))
    sender.send(entities.events, np.array(rows), columns)


def send_residuals(sender: Sender, entities: Entities, colours: Mapping[str, Colour]) -> None:
    """Send arrows at the drone for the specific force that models leave open, 0.1 m for 1 m/s^2.

    colours: by the names of models.
    """
    for name, forces_w in sender.flight.residuals_w.items():
        is_known = np.isfinite(forces_w).all(axis=1)
        if is_known.any():
            # No arrow in the row after a known one, or it would stand there until the next.
            rows = np.flatnonzero(is_known | np.append(False, is_known[:-1]))
            known = rows[is_known[rows]]
            vectors, origins = SCALED_FORCE * forces_w[known], sender.flight.positions[known]
            arrows = rr.Arrows3D.columns(vectors=vectors, origins=origins)
            entity = f"{entities.residual}/{rr.escape_entity_path_part(name)}"
            style = rr.Arrows3D.from_fields(radii=ARROW_RADIUS, colors=colours[name])
            sender.recording.log(entity, style, static=True, strict=True)
            sender.send(entity, rows, arrows.partition(is_known[rows].astype(int)))
