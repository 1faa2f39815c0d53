"""The entities of a recording: those logged once, and those sent for all steps as columns."""

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from flytrack_env import scene
from flytrack_env.camera import FIELD_OF_VIEW_DEG, PITCH_DEG
from flytrack_env.flown_camera import HEIGHT_PX, MASK_PX, WIDTH_PX, film
from flytrack_env.flown_race import FlownRace
from flytrack_env.scene import Colour, gates_of, rotations
from flytrack_env.state import APPLIED_ACTION, BATTERY, QUATERNION, RATES, VELOCITY, Action
from flytrack_env.tracks import Track, build_course
from flytrack_env.viz_rerun.trajectory import Trajectory

CORNERS, MASK = "camera_corners", "camera_mask"  # entities below the drone's
MASK_EVERY = 4  # steps: a mask is 4 kB
CAMERA_RAY_M, DIRECTION_M = 0.3, 1.0
SCALED_FORCE = 0.1  # m of an arrow per m/s^2
DIM = 0.6  # of the commanded action's line beside the applied one's
THIN, THICK = 1.0, 2.0
# On the screen, so that they are seen from the other end of the course.
PATH_RADIUS, PASS_RADIUS, LAP_RADIUS, ARROW_RADIUS, DRONE_RADIUS = (
    float(np.asarray(rr.Radius.ui_points(points))) for points in (1.5, 3.5, 5.0, 2.5, 6.0)
)


class Plot(NamedTuple):
    """One line of a plot: its path below that of the plots, label, values (T,), and model."""

    path: str
    label: str
    values: np.ndarray
    model: str = ""


def centres_of(track: Track | None) -> np.ndarray:
    """Return the centres of a track's gates, (num_gates, 3), world, m."""
    return np.reshape([gate.position for gate in track.gates] if track else [], (-1, 3))


def log_once(recording: rr.RecordingStream, entity: str, archetype: rr.AsComponents) -> None:
    """Log what is the same at all times."""
    recording.log(entity, archetype, static=True, strict=True)


def log_course(recording: rr.RecordingStream, track: Track | None) -> None:
    """Log axes, gates (centre, frame, opening, direction of flight) and bounds, once."""
    log = partial(log_once, recording)
    log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    if track is None:
        return
    style: Any = {"colors": scene.NEXT_GATE}
    positions = centres_of(track)
    names = [f"gate {gate.id}" for gate in track.gates]
    log("world/gates/centre", rr.Points3D(positions, labels=names, radii=0.05, **style))
    if track.gates:
        gates = gates_of(build_course(track))
        # Between the corners of frame and opening there are four plates of two triangles.
        corners = np.concatenate([gates.outer, gates.inner], axis=1)
        plates = np.array(
            [((k, (k + 1) % 4, k + 4), ((k + 1) % 4, (k + 1) % 4 + 4, k + 4)) for k in range(4)]
        )
        firsts = 8 * np.arange(len(corners))[:, None, None]
        triangles = (firsts + plates.reshape(1, -1, 3)).reshape(-1, 3)
        points = corners.reshape(-1, 3)
        colours = np.tile(scene.NEXT_GATE, (len(points), 1))
        log(
            "world/gates/frame",
            rr.Mesh3D(vertex_positions=points, triangle_indices=triangles, vertex_colors=colours),
        )
        forward = DIRECTION_M * gates.forward
        log(
            "world/gates/direction",
            rr.Arrows3D(vectors=forward, origins=positions, radii=0.02, **style),
        )
    low, high = np.array(track.bounds_low), np.array(track.bounds_high)
    if np.isfinite(high - low).all():
        box = rr.Boxes3D(
            centers=[0.5 * (low + high)],
            half_sizes=[0.5 * (high - low)],
            fill_mode=rr.components.FillMode.MajorWireframe,
            colors=scene.BOUNDS,
        )
        log("world/bounds", box)


def plots_of(trajectory: Trajectory, race: FlownRace | None) -> list[Plot]:
    """Return the lines of a flight's plots."""
    states = trajectory.states
    plots = [
        Plot("speed", "speed [m/s]", np.linalg.norm(states[:, VELOCITY], axis=1)),
        Plot("angular_speed", "angular speed [rad/s]", np.linalg.norm(states[:, RATES], axis=1)),
        Plot("battery", "battery [V]", states[:, BATTERY]),
    ]
    applied = states[:, APPLIED_ACTION]
    for column, name in enumerate(Action._fields):
        plots.append(Plot(f"action/{name}", f"{name} action", trajectory.actions[:, column]))
        plots.append(Plot(f"applied/{name}", f"{name} applied", applied[:, column]))
    attitudes = Rotation.from_quat(states[:, QUATERNION], scalar_first=True)
    angles_deg = np.unwrap(attitudes.as_euler("ZYX", degrees=True), period=360.0, axis=0)
    for name, values in zip(("yaw", "pitch", "roll"), angles_deg.T, strict=True):
        plots.append(Plot(f"orientation/{name}", f"{name} [deg]", values))
    if race is not None:
        plots.append(Plot("gate_distance", "distance to the next gate [m]", race.gate_distance_m))
    for name, forces_w in trajectory.residuals_w.items():
        path = f"residual/{rr.escape_entity_path_part(name)}"
        size = np.linalg.norm(forces_w, axis=1)
        plots.append(Plot(path, f"force not explained by {name} [m/s²]", size, name))
    return plots


class Writer:
    """Writes the entities of one flight.

    The first flight has ``world/drone`` and so on, as in the handout; others
    ``world/flights/NAME/drone``, and only plots with numbers.

    Args:
        track: None shows no gates.
        colours: by the names of flights and models.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        trajectory: Trajectory,
        track: Track | None,
        is_first: bool,
        colours: dict[str, Colour],
    ):
        part = "" if is_first else f"/flights/{rr.escape_entity_path_part(trajectory.name)}"
        self.world, self.plots, self.events = f"world{part}", f"plots{part}", f"events{part}"
        self.recording, self._log = recording, partial(log_once, recording)
        self.trajectory, self.track, self.colours = trajectory, track, colours
        self.all_rows = np.arange(len(trajectory.states))
        self.race = trajectory.race(track)
        self.ended = trajectory.reason_ended(track, self.race)
        plots = plots_of(trajectory, self.race)
        self.lines = [plot for plot in plots if is_first or np.isfinite(plot.values).any()]

    def write(self, label: str) -> None:
        """Write all of the flight.

        Args:
            label: before the name of each line.
        """
        self._log_drone()
        self._send_poses()
        self._send_path()
        for plot in self.lines:
            self._send_plot(plot, label)
        for model, forces_w in self.trajectory.residuals_w.items():
            self._send_arrows(model, forces_w)
        self._send_events()
        if self.race is not None and self.race.passes:
            self._send_passes(self.race)

    def _send_events(self) -> None:
        """Send a text at every gate passed, every lap, and the end."""
        events = []
        if self.track is not None and self.race is not None:
            for gate_pass in self.race.passes:
                gate = self.track.gates[gate_pass.gate].id
                events.append((gate_pass.row, f"gate {gate}, {gate_pass.time_s:.3f} s"))
                if gate_pass.lap:  # an event of its own, as the panel is narrow
                    lap = f"lap {gate_pass.lap}, {gate_pass.lap_time_s:.3f} s"
                    events.append((gate_pass.row, lap))
        events.append((int(self.all_rows[-1]), f"ended, {self.ended}"))
        rows = np.array([row for row, _ in events])
        texts = [f"{self.trajectory.name}: {text}" for _, text in events]
        columns = rr.TextLog.columns(text=texts, level=["INFO"] * len(texts))
        self._send(self.events, rows, columns)

    def _send(self, entity: str, rows: np.ndarray, columns: rr.ComponentColumnList) -> None:
        """Send an entity's columns for these rows; rows after the end count as the last one."""
        rows = np.minimum(rows, self.all_rows[-1])
        indexes = [
            rr.TimeColumn("step", sequence=rows),
            rr.TimeColumn(
                "sim_time", duration=self.trajectory.time_ns[rows].astype("timedelta64[ns]")
            ),
        ]
        self.recording.send_columns(entity, indexes, columns, strict=True)

    def _log_drone(self) -> None:
        """Log the drone's body in its own frame, and the style of its path and passes, once."""
        drone, colour = f"{self.world}/drone", self.colours[self.trajectory.name]
        pitch = math.radians(PITCH_DEG)
        ray_b = CAMERA_RAY_M * np.array([math.cos(pitch), 0.0, math.sin(pitch)])
        self._log(f"{drone}/motors", rr.Points3D(scene.MOTORS_B, radii=0.06, colors=colour))
        self._log(f"{drone}/arms", rr.LineStrips3D(scene.ARMS_B, radii=0.025, colors=colour))
        # On the screen, so that the drone is seen from the other end of the course.
        body = rr.Points3D([(0.0, 0.0, 0.0)], radii=DRONE_RADIUS, colors=colour)
        self._log(f"{drone}/body", body)
        ray = rr.Arrows3D(vectors=[ray_b], origins=[(0.0, 0.0, 0.0)], colors=scene.CAMERA)
        self._log(f"{drone}/camera", ray)
        for name in ("flown", "recent"):
            style = rr.LineStrips3D.from_fields(radii=PATH_RADIUS, colors=colour)
            self._log(f"{self.world}/trajectory/{name}", style)
        self._log(f"{self.world}/passes", rr.Points3D.from_fields(radii=PASS_RADIUS, colors=colour))
        laps = rr.Points3D.from_fields(radii=LAP_RADIUS, colors=colour, show_labels=True)
        self._log(f"{self.world}/laps", laps)

    def send_camera(self) -> None:
        """Send what the camera sees, where the race is known: corners, and masks at 25 Hz.

        Each is the image of a pinhole in the drone's frame.
        """
        if self.race is None or self.track is None:
            return
        shown = film(self.trajectory.states, self.race.gate, self.track)
        half_pitch = 0.5 * math.radians(PITCH_DEG)
        up = rr.Transform3D(
            quaternion=rr.Quaternion(xyzw=[0.0, -math.sin(half_pitch), 0.0, math.cos(half_pitch)])
        )
        for name, width, height in ((CORNERS, WIDTH_PX, HEIGHT_PX), (MASK, MASK_PX, MASK_PX)):
            entity = f"{self.world}/drone/{name}"
            focal_px = 0.5 * width / math.tan(0.5 * math.radians(FIELD_OF_VIEW_DEG))
            pinhole = rr.Pinhole(
                focal_length=focal_px,
                width=width,
                height=height,
                camera_xyz=rr.ViewCoordinates.FLU,
                image_plane_distance=CAMERA_RAY_M,
            )
            self._log(entity, up)
            self._log(entity, pinhole)
        points = [row[flags] for row, flags in zip(shown.corners_px, shown.is_visible, strict=True)]
        shades = np.repeat([scene.NEXT_GATE, scene.CAMERA], 4, axis=0).reshape(2, 4, 3)
        colours = np.concatenate([shades[flags] for flags in shown.is_visible])
        columns = rr.Points2D.columns(positions=np.concatenate(points), colors=colours)
        lengths = [len(row) for row in points]
        corners = f"{self.world}/drone/{CORNERS}/points"
        self._log(corners, rr.Points2D.from_fields(radii=PASS_RADIUS))
        self._send(corners, self.all_rows, columns.partition(lengths))
        rows = self.all_rows[::MASK_EVERY]
        picture = rr.components.ImageFormat(
            width=MASK_PX, height=MASK_PX, color_model="L", channel_datatype="U8"
        )
        masks = shown.masks[rows].reshape(len(rows), -1)
        columns = rr.Image.columns(buffer=masks, format=[picture] * len(rows))
        self._send(f"{self.world}/drone/{MASK}", rows, columns)

    def _send_poses(self) -> None:
        """Send the drone's pose, and for the view from behind a level frame, x ahead."""
        states, positions = self.trajectory.states, self.trajectory.positions
        x_first = np.roll(states[:, QUATERNION], -1, axis=1)
        pose = rr.Transform3D.columns(translation=positions, quaternion=x_first)
        self._send(f"{self.world}/drone", self.all_rows, pose)
        # In the direction of flight; at rest, where the nose points.
        ahead_w = (
            np.nan_to_num(states[:, VELOCITY][:, :2]) + rotations(states[:, QUATERNION])[:, :2, 0]
        )
        half_yaw = 0.5 * np.arctan2(ahead_w[:, 1], ahead_w[:, 0])
        level = np.zeros_like(half_yaw)
        quaternions = np.stack([level, level, np.sin(half_yaw), np.cos(half_yaw)], axis=1)
        frame = rr.Transform3D.columns(translation=positions, quaternion=quaternions)
        self._send(f"{self.world}/chase", self.all_rows, frame)

    def _send_path(self) -> None:
        """Send the path flown so far, for every step from 1 on.

        The whole path in every row would grow with T^2. So ``flown`` holds it up to the last
        multiple of ``block`` and changes once a block, and ``recent`` holds the rest; sqrt(T)
        balances the two.
        """
        positions, restarts = self.trajectory.positions, self.trajectory.restarts
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
        for name, (rows, line_sets) in paths.items():
            if line_sets:
                columns = rr.LineStrips3D.columns(
                    strips=[strip for lines in line_sets for strip in lines]
                )
                lengths = [len(lines) for lines in line_sets]
                self._send(f"{self.world}/trajectory/{name}", rows, columns.partition(lengths))

    def _send_plot(self, plot: Plot, label: str) -> None:
        """Send a line of a plot, in the colour of its model or of the flight, and its name once.

        It has a gap where the path begins anew: the drone did not move from one to the other.
        """
        entity, is_command = f"{self.plots}/{plot.path}", plot.path.startswith("action/")
        colour = self.colours[plot.model or self.trajectory.name]
        shade = tuple(int(DIM**is_command * part) for part in colour)
        width = THIN if is_command else THICK
        self._log(entity, rr.SeriesLines(names=label + plot.label, colors=shade, widths=width))
        self._send(entity, self.all_rows, rr.Scalars.columns(scalars=self._with_gaps(plot.values)))

    def _with_gaps(self, values: np.ndarray) -> np.ndarray:
        """Return values of all rows, NaN where the path begins anew but in the first row."""
        if self.trajectory.restarts is None:
            return values
        is_gap = self.trajectory.restarts & (np.arange(len(values)) > 0)
        return np.where(is_gap, np.nan, values)

    def _send_passes(self, race: FlownRace) -> None:
        """Send markers where gates were passed, all so far, and at the last lap's end its time."""
        # Of two gates passed in one step the later has both markers.
        last = {gate_pass.row: count for count, gate_pass in enumerate(race.passes, start=1)}
        positions = [
            [gate_pass.pos_w for gate_pass in race.passes[:count]] for count in last.values()
        ]
        points = rr.Points3D.columns(positions=np.concatenate(positions))
        lengths = [len(group) for group in positions]
        self._send(f"{self.world}/passes", np.array(list(last)), points.partition(lengths))
        laps = [gate_pass for gate_pass in race.passes if gate_pass.lap]
        if laps:
            labels = [f"lap {gate_pass.lap}: {gate_pass.lap_time_s:.3f} s" for gate_pass in laps]
            markers = rr.Points3D.columns(
                positions=[gate_pass.pos_w for gate_pass in laps], labels=labels
            )
            self._send(
                f"{self.world}/laps", np.array([gate_pass.row for gate_pass in laps]), markers
            )

    def _send_arrows(self, model: str, forces_w: np.ndarray) -> None:
        """Send arrows at the drone for the specific force that a model does not explain."""
        is_known = np.isfinite(forces_w).all(axis=1)
        if not is_known.any():
            return
        # No arrow in the row after a known one, or it would stand there until the next.
        rows = np.flatnonzero(is_known | np.append(False, is_known[:-1]))
        known = rows[is_known[rows]]
        vectors, origins = SCALED_FORCE * forces_w[known], self.trajectory.positions[known]
        arrows = rr.Arrows3D.columns(vectors=vectors, origins=origins)
        entity = f"{self.world}/residual/{rr.escape_entity_path_part(model)}"
        self._log(entity, rr.Arrows3D.from_fields(radii=ARROW_RADIUS, colors=self.colours[model]))
        self._send(entity, rows, arrows.partition(is_known[rows].astype(int)))
