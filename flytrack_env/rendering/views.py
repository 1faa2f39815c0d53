"""A picture of a flight: the course from above, the flight from behind, and a line of text."""

from collections.abc import Sequence
from functools import cache
from weakref import WeakKeyDictionary

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from flytrack_env import scene
from flytrack_env.rendering.camera import Camera, unit
from flytrack_env.rendering.flight_log import GATE_INDEX, LAP_START, LAP_TIME, LAPS, FlightLog
from flytrack_env.scene import UP_W, Colour, Gates, gates_of, ground_grid, rotations, speed_colours
from flytrack_env.state import BATTERY, POSITION, QUATERNION, VELOCITY
from flytrack_env.tracks import Course

# Pixels of the picture. All but text is drawn PIXEL times larger and averaged: Pillow's lines are
# jagged.
WIDTH, HEIGHT = 960, 540
TOP_VIEW_WIDTH = 400  # the chase view has the rest
PIXEL = 2
TEXT_SIZE, TEXT_TOP, BAR_HEIGHT = 15, 12, 34
COLUMNS = (14, 78, 182, 262, 340, 460)  # left edge of each text above the chase view

# The view from above, in pixels of the picture where nothing else is said.
MARGIN = 28  # around the bounds
GRID_M = 5.0
WIDE_M = 60.0  # a course of more than this, or of more than twice, has a grid that much wider
MIN_GATE_LENGTH = 26  # gates of a wide course are drawn larger than they are
LABEL_DISTANCE = 11
ARROW, DRONE_LENGTH = 18, 20
# The drone's arrow, nose at +x, in units of its length.
ARROWHEAD = np.array([(0.6, 0.0), (-0.4, 0.38), (-0.2, 0.0), (-0.4, -0.38)])

# The view from behind.
FIELD_OF_VIEW_DEG = 80.0
BEHIND_M, ABOVE_M = 2.0, 0.65
MIN_CAMERA_HEIGHT_M = 0.25  # of the camera above the floor
LOOK_AHEAD_M = 5.0
# beyond the gate's centre, so that the view does not swing round as a gate is passed
AIM_BEYOND_M = 3.0
SWING_STEPS = 25.0  # time constant with which the camera follows its aim
HEADING_STEPS = 8.0  # and the nose
MEMORY_STEPS, TRAIL_STEPS = 100, 150
CHASE_GRID_M = 2.0
BODY_M, SHADOW_M = 0.05, 0.2
DRONE_COLOURS = (scene.DRONE, scene.FRONT_ROTOR, scene.REAR_ROTOR)
GHOST_COLOURS = (scene.CAMERA, scene.blend(scene.CAMERA, scene.DRONE, 0.5), scene.CAMERA)
ANGLES = np.linspace(0.0, 2.0 * np.pi, 14, endpoint=False)
CIRCLE = np.stack([np.cos(ANGLES), np.sin(ANGLES), np.zeros(14)], axis=-1)


@cache
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return Pillow's own font in a size, pixels."""
    return ImageFont.load_default(size)


class Floor:
    """Draws the floor of a course with a grid, in perspective."""

    def __init__(self, course: Course, spacing_m: float):
        low, high = (np.array(corner, float) for corner in (course.bounds_low, course.bounds_high))
        self.height_m = low[2]
        self.grid_w = ground_grid(low, high, spacing_m)
        corners = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
        self.corners_w = np.array([(x, y, low[2]) for x, y in corners])

    def draw(self, draw: ImageDraw.ImageDraw, camera: Camera) -> None:
        """Draw the floor within the bounds."""
        fill(draw, camera, camera.look(self.corners_w), scene.GROUND)
        self.draw_grid(draw, camera)

    def draw_grid(self, draw: ImageDraw.ImageDraw, camera: Camera) -> None:
        """Draw its grid alone."""
        for line in camera.look(self.grid_w):
            draw.line(camera.polygon(line), scene.GROUND_GRID, PIXEL)


class TopView:
    """Draws the course from above, the trail, and the drone as an arrow.

    Trails are kept between pictures.

    Args:
        width: of its part of the canvas, pixels.
        height: the same.
    """

    def __init__(
        self, course: Course, gates: Gates, gate_ids: Sequence[int], width: int, height: int
    ):
        self.gates = gates
        low, high = (np.array(corner, float) for corner in (course.bounds_low, course.bounds_high))
        self._fit(low[:2], high[:2], width, height)
        self.half_edges_m = 0.5 * np.linalg.norm(gates.outer[:, 1] - gates.outer[:, 0], axis=1)
        self.pixel_m = PIXEL / self.scale
        self.enlargement = max(
            1.0, MIN_GATE_LENGTH * self.pixel_m / (2.0 * self.half_edges_m.min())
        )
        self.empty = Image.new("RGB", (width, height), scene.BACKGROUND)
        self._draw_course(low, high, gate_ids)
        # The trail of each flight that was drawn, and how many of its rows are in it.
        self.trails: WeakKeyDictionary[FlightLog, tuple[Image.Image, int]] = WeakKeyDictionary()

    def _fit(self, low: np.ndarray, high: np.ndarray, width: int, height: int) -> None:
        """Choose scale and orientation: world x to the right, or upwards where that is larger."""
        room = np.array([width, height]) - 2 * MARGIN * PIXEL
        size = high - low
        is_turned = min(room / size[::-1]) > min(room / size)
        # Columns: what a metre along world x and along world y is on the picture, y downwards.
        axes = (
            np.array([(0.0, -1.0), (-1.0, 0.0)])
            if is_turned
            else np.array([(1.0, 0.0), (0.0, -1.0)])
        )
        self.scale = float(min(room / (size[::-1] if is_turned else size)))
        self.axes = self.scale * axes
        self.offset = 0.5 * np.array([width, height]) - self.axes @ (0.5 * (low + high))

    def pixels(self, points_w: np.ndarray) -> np.ndarray:
        """Return where points (..., >=2), world, m, are on the canvas, (..., 2)."""
        return points_w[..., :2] @ self.axes.T + self.offset

    def _pairs(self, points_w: np.ndarray) -> list[tuple[float, float]]:
        return [(x, y) for x, y in self.pixels(points_w).tolist()]

    def _draw_course(self, low: np.ndarray, high: np.ndarray, gate_ids: Sequence[int]) -> None:
        draw = ImageDraw.Draw(self.empty)
        for line in ground_grid(low, high, GRID_M * np.ceil((high - low)[:2].max() / WIDE_M)):
            draw.line(self._pairs(line), scene.GRID, PIXEL)
        corners = np.array([low[:2], (high[0], low[1]), high[:2], (low[0], high[1]), low[:2]])
        draw.line(self._pairs(corners), scene.BOUNDS, PIXEL)
        for index, (centre, forward) in enumerate(
            zip(self.gates.centres, self.gates.forward, strict=True)
        ):
            self._draw_gate(draw, index, scene.GATE)
            left = np.array([-forward[1], forward[0]]) / max(np.hypot(forward[0], forward[1]), 1e-6)
            outwards = left if left @ (centre - 0.5 * (low + high))[:2] >= 0.0 else -left
            distance = self.enlargement * self.half_edges_m[index] + LABEL_DISTANCE * self.pixel_m
            (label_px,) = self._pairs((centre[:2] + distance * outwards)[None])
            draw.text(label_px, str(gate_ids[index]), scene.TEXT, font(13 * PIXEL), anchor="mm")

    def _draw_gate(self, draw: ImageDraw.ImageDraw, index: int, colour: Colour) -> None:
        """Draw a gate as a bar with a gap as its opening, and an arrow in its flight direction."""
        middle = self.gates.centres[index]
        for corners, shade, width in (
            (self.gates.outer[index], colour, 4),
            (self.gates.inner[index], scene.BACKGROUND, 2),
        ):
            draw.line(
                self._pairs(middle + self.enlargement * (corners - middle)), shade, width * PIXEL
            )
        centre, arrow = middle[:2], ARROW * self.pixel_m * self.gates.forward[index, :2]
        base, across = centre + 0.6 * arrow, 0.25 * np.array([-arrow[1], arrow[0]])
        draw.line(self._pairs(np.array([centre, base])), colour, PIXEL)
        draw.polygon(self._pairs(np.array([centre + arrow, base + across, base - across])), colour)

    def draw(self, canvas: Image.Image, log: FlightLog, ghost: np.ndarray | None) -> None:
        """Draw the log's last row, the trail of all rows and a ghost (21,), at the left."""
        canvas.paste(self._extend_trail(log), (0, 0))
        draw = ImageDraw.Draw(canvas)
        row = log.rows[-1].astype(float)
        self._draw_gate(draw, int(row[GATE_INDEX]), scene.NEXT_GATE)
        if ghost is not None:
            self._draw_arrow(draw, ghost, GHOST_COLOURS[0])
        self._draw_arrow(draw, row, scene.DRONE)

    def _draw_arrow(self, draw: ImageDraw.ImageDraw, state: np.ndarray, colour: Colour) -> None:
        nose = rotations(state[QUATERNION])[:2, 0] @ self.axes.T
        angle = np.arctan2(nose[1], nose[0])
        turn = np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])
        shape = DRONE_LENGTH * PIXEL * ARROWHEAD @ turn + self.pixels(state[POSITION])
        outline = [(x, y) for x, y in shape.tolist()]
        draw.polygon(outline, colour, outline=scene.BACKGROUND, width=PIXEL)

    def _extend_trail(self, log: FlightLog) -> Image.Image:
        """Return the course with the trail; only what was flown since the last picture is drawn."""
        picture, num_drawn = self.trails.get(log) or (self.empty.copy(), 0)
        new = log.rows[max(num_drawn - 1, 0) :]
        draw = ImageDraw.Draw(picture)
        points = self._pairs(new[:, POSITION])
        colours = speed_colours(np.linalg.norm(new[1:, VELOCITY], axis=1))
        for start, end, colour in zip(points, points[1:], colours, strict=False):
            draw.line([start, end], colour, 2 * PIXEL)
        self.trails[log] = picture, len(log.rows)
        return picture


class ChaseView:
    """Draws the flight from behind the drone, in perspective: gates, ground, trail and drone.

    Args:
        left: pixels of the canvas that belong to another view.
        width: of this one.
        height: the same.
    """

    def __init__(self, course: Course, gates: Gates, left: int, width: int, height: int):
        self.gates, self.left, self.width, self.height = gates, left, width, height
        self.corners_w = np.concatenate([gates.outer, gates.inner], axis=1)
        self.focal_px = 0.5 * width / np.tan(0.5 * np.radians(FIELD_OF_VIEW_DEG))
        self.centre_px = np.array([0.5 * width, 0.5 * height])
        self.floor = Floor(course, CHASE_GRID_M)

    def camera(self, rows: np.ndarray, follows_nose: bool = False) -> Camera:
        """Return the camera behind the drone, looking towards the next gate, or ahead.

        It follows slowly: its direction is the mean over the last rows, the latest weighing most.
        """
        recent = rows[-MEMORY_STEPS:].astype(float)
        index = recent[:, GATE_INDEX].astype(int)
        to_aim_w = (
            self.gates.centres[index]
            + AIM_BEYOND_M * self.gates.forward[index]
            - recent[:, POSITION]
        )
        to_aim_w /= np.maximum(np.linalg.norm(to_aim_w, axis=1, keepdims=True), 1e-6)
        if follows_nose:
            # The heading is the turn about the vertical before any tilt: rolls and loops leave it
            # alone.
            w, _, _, z = recent[:, QUATERNION].T
            to_aim_w = np.stack([w * w - z * z, 2.0 * w * z, 0.0 * w], axis=-1)
        weights = np.exp(
            np.arange(1 - len(to_aim_w), 1) / (HEADING_STEPS if follows_nose else SWING_STEPS)
        )
        direction = unit(weights @ to_aim_w, self.gates.forward[index[-1]])
        # Half the slope, so that the horizon stays in sight.
        direction = unit(direction * np.array([1.0, 1.0, 0.5]), np.array([1.0, 0.0, 0.0]))
        drone_w = recent[-1, POSITION]
        eye_w = drone_w - BEHIND_M * direction + ABOVE_M * UP_W
        eye_w[2] = max(eye_w[2], self.floor.height_m + MIN_CAMERA_HEIGHT_M)
        forward = unit(drone_w + LOOK_AHEAD_M * direction - eye_w, direction)
        return Camera(eye_w, forward, self.centre_px, self.focal_px)

    def draw(
        self,
        canvas: Image.Image,
        log: FlightLog,
        ghost: np.ndarray | None = None,
        follows_nose: bool = False,
    ) -> None:
        """Draw the view of the log's last row, and a ghost (21,) in it; see also ``camera``."""
        row = log.rows[-1].astype(float)
        camera = self.camera(log.rows, follows_nose)
        picture = Image.new("RGB", (self.width, self.height), scene.SKY)
        draw = ImageDraw.Draw(picture)
        horizon = max(camera.horizon_px(), 0.0)
        if horizon < self.height:
            draw.rectangle([0, horizon, self.width, self.height], scene.GROUND)
        self.floor.draw_grid(draw, camera)
        below_w = np.array([*row[POSITION][:2], self.floor.height_m])
        fill(draw, camera, camera.look(below_w + SHADOW_M * CIRCLE), scene.SHADOW)
        distances_m = np.linalg.norm(self.gates.centres - camera.eye_w, axis=1)
        is_beyond = distances_m > np.linalg.norm(row[POSITION] - camera.eye_w)
        corners_c, colours = camera.look(self.corners_w), [scene.GATE] * len(self.corners_w)
        colours[int(row[GATE_INDEX])] = scene.NEXT_GATE
        order = np.argsort(-distances_m)
        for index in order[is_beyond[order]]:
            draw_gate(draw, camera, corners_c[index], colours[index])
        self._draw_trail(draw, camera, log.rows)
        drones = [*([] if ghost is None else [(ghost, GHOST_COLOURS)]), (row, DRONE_COLOURS)]
        for state, shades in sorted(
            drones, key=lambda drone: -float(camera.look(drone[0][POSITION])[2])
        ):
            draw_drone(draw, camera, state[POSITION], state[QUATERNION], shades)
        for index in order[~is_beyond[order]]:
            # An outline only, so that the drone is seen through it.
            draw_outlines(draw, camera, corners_c[index], colours[index])
        canvas.paste(picture, (self.left, 0))

    def _draw_trail(self, draw: ImageDraw.ImageDraw, camera: Camera, rows: np.ndarray) -> None:
        recent = rows[-TRAIL_STEPS:].astype(float)
        points_c = camera.look(recent[:, POSITION])
        colours = speed_colours(np.linalg.norm(recent[1:, VELOCITY], axis=1))
        for start, colour in enumerate(colours):
            draw.line(camera.polygon(points_c[start : start + 2]), colour, 2 * PIXEL)


def fill(
    draw: ImageDraw.ImageDraw,
    camera: Camera,
    points_c: np.ndarray,
    colour: Colour,
    outline: Colour | None = None,
) -> None:
    """Draw the visible part of a polygon (n, 3), camera's frame."""
    polygon = camera.polygon(points_c)
    if polygon:
        draw.polygon(polygon, colour, outline, PIXEL)


def draw_gate(
    draw: ImageDraw.ImageDraw, camera: Camera, corners_c: np.ndarray, colour: Colour
) -> None:
    """Draw a gate's frame as a solid ring.

    Args:
        corners_c: (8, 3), outer four and inner four, camera's frame.
    """
    for a in range(4):
        b = (a + 1) % 4
        fill(draw, camera, corners_c[[a, b, 4 + b, 4 + a]], colour)
    draw_outlines(draw, camera, corners_c, scene.blend(colour, scene.BACKGROUND, 0.4))


def draw_outlines(
    draw: ImageDraw.ImageDraw, camera: Camera, corners_c: np.ndarray, colour: Colour
) -> None:
    """Draw the edges of a gate's frame and opening; corners as for ``draw_gate``."""
    for square_c in (corners_c[:4], corners_c[4:]):
        outline = camera.polygon(square_c)
        if outline:
            draw.line(outline + outline[:2], colour, PIXEL)


def draw_drone(
    draw: ImageDraw.ImageDraw,
    camera: Camera,
    pos_w: np.ndarray,
    quaternion: np.ndarray,
    colours: tuple[Colour, Colour, Colour] = DRONE_COLOURS,
    enlargement: float = 1.0,
) -> None:
    """Draw arms, rotors and body of a drone, the far rotors first.

    Args:
        colours: of body, front rotors and rear rotors.
    """
    axes_w = enlargement * rotations(quaternion).T
    motors_w = pos_w + scene.MOTORS_B @ axes_w
    for line in camera.look(pos_w + scene.ARMS_B @ axes_w):
        draw.line(camera.polygon(line), colours[0], 4 * PIXEL)
    disc_w = scene.ROTOR_M * CIRCLE @ axes_w
    body_w = pos_w + enlargement * BODY_M * (
        CIRCLE @ np.stack([camera.axes[0], camera.axes[1], UP_W])
    )
    parts = [(motor_w + disc_w, colours[1 + index // 2]) for index, motor_w in enumerate(motors_w)]
    looked = [
        (camera.look(points_w), colour) for points_w, colour in [*parts, (body_w, colours[0])]
    ]
    for points_c, colour in sorted(looked, key=lambda part: -part[0][:, 2].mean()):
        fill(draw, camera, points_c, colour, scene.BACKGROUND)


class Renderer:
    """Draws pictures of any number of flights on one course, 960 x 540 pixels.

    A flight that was drawn before costs only what was flown since: its trail is kept as long as its
    log.
    """

    def __init__(self, course: Course, gate_ids: Sequence[int]):
        width, height, split = PIXEL * WIDTH, PIXEL * HEIGHT, PIXEL * TOP_VIEW_WIDTH
        gates, self.gate_ids = gates_of(course), gate_ids
        self.top_view = TopView(course, gates, gate_ids, split, height)
        self.chase_view = ChaseView(course, gates, split, width - split, height)
        self.canvas = Image.new("RGB", (width, height))

    def draw(
        self,
        log: FlightLog,
        ghost: np.ndarray | None = None,
        follows_nose: bool = False,
        notes: str = "",
    ) -> np.ndarray:
        """Return a picture of the log's last row and the way there, (540, 960, 3), uint8.

        Args:
            ghost: state (21,) of a second drone to show.
            follows_nose: whether the camera looks where the drone's nose points, as a pilot needs
                it, and not to the next gate.
            notes: lines of text on the chase view.

        Raises:
            ValueError: an empty log.
        """
        if len(log.rows) == 0:
            raise ValueError("log: found no rows, expected at least one")
        self.top_view.draw(self.canvas, log, ghost)
        self.chase_view.draw(self.canvas, log, ghost, follows_nose)
        picture = self.canvas.reduce(PIXEL)
        draw = ImageDraw.Draw(picture)
        self._write(draw, log)
        notes_px = (TOP_VIEW_WIDTH + COLUMNS[0], BAR_HEIGHT + TEXT_TOP)
        draw.multiline_text(notes_px, notes, scene.TEXT, font(TEXT_SIZE), spacing=6)
        return np.array(picture)

    def _write(self, draw: ImageDraw.ImageDraw, log: FlightLog) -> None:
        """Write lap, gate, speed, battery and lap times above the chase view."""
        row = log.rows[-1].astype(float)
        texts = (
            f"lap {row[LAPS] + 1:.0f}",
            f"next gate {self.gate_ids[int(row[GATE_INDEX])]}",
            f"{np.linalg.norm(row[VELOCITY]):.1f} m/s",
            f"{row[BATTERY]:.2f} V",
            f"lap time {log.time_s - row[LAP_START]:.2f} s",
            f"last {row[LAP_TIME]:.2f} s" if row[LAP_TIME] > 0.0 else "",
        )
        draw.rectangle([TOP_VIEW_WIDTH, 0, WIDTH, BAR_HEIGHT], scene.BACKGROUND)
        for column, text in zip(COLUMNS, texts, strict=True):
            draw.text((TOP_VIEW_WIDTH + column, TEXT_TOP), text, scene.TEXT, font(TEXT_SIZE))
