"""One picture of a flight: the course from above with trail and drone, and a line of text."""

from functools import cache
from weakref import WeakKeyDictionary

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from flytrack_env import scene
from flytrack_env.rendering.flight_log import GATE_INDEX, LAP_START, LAP_TIME, LAPS, FlightLog
from flytrack_env.scene import Colour, gates_of, ground_grid, rotations, speed_colours
from flytrack_env.state import BATTERY, POSITION, QUATERNION, VELOCITY
from flytrack_env.tracks import Course

# Pixels of the picture. All but text is drawn PIXEL times larger and averaged: Pillow's lines are jagged.
WIDTH, HEIGHT = 960, 540
PIXEL = 2
TEXT_SIZE, TEXT_LEFT, TEXT_TOP, BAR_HEIGHT = 15, 14, 12, 34
MARGIN = 28  # around the bounds
GRID_M = 5.0
WIDE_M = 60.0  # a course of more than this, or of more than twice, has a grid that much wider
SMALLEST_GATE = 26  # gates of a wide course are drawn larger than they are
LABEL_DISTANCE = 11
ARROW, DRONE_LENGTH = 18, 20
# The drone's arrow, nose at +x, in units of its length.
ARROWHEAD = np.array([(0.6, 0.0), (-0.4, 0.38), (-0.2, 0.0), (-0.4, -0.38)])


@cache
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return Pillow's own font in a size, pixels."""
    return ImageFont.load_default(size)


class Renderer:
    """Draws pictures of any number of flights on one course from above, the drone as an arrow.

    A flight that was drawn before costs only what was flown since: its trail is kept as long as its log.
    """

    def __init__(self, course: Course):
        self.gates = gates_of(course)
        low, high = (np.array(corner, float) for corner in (course.bounds_low, course.bounds_high))
        self._fit(low[:2], high[:2])
        self.half_edges_m = 0.5 * np.linalg.norm(self.gates.outer[:, 1] - self.gates.outer[:, 0], axis=1)
        self.pixel_m = PIXEL / self.scale
        self.enlargement = max(1.0, SMALLEST_GATE * self.pixel_m / (2.0 * self.half_edges_m.min()))
        self.empty = Image.new("RGB", (PIXEL * WIDTH, PIXEL * HEIGHT), scene.BACKGROUND)
        self._draw_course(low, high)
        # The trail of each flight that was drawn, and how many of its rows are in it.
        self.trails: WeakKeyDictionary[FlightLog, tuple[Image.Image, int]] = WeakKeyDictionary()

    def _fit(self, low: np.ndarray, high: np.ndarray) -> None:
        """Choose scale and orientation: world x to the right, or upwards where that is larger."""
        room = PIXEL * (np.array([WIDTH, HEIGHT - BAR_HEIGHT]) - 2 * MARGIN)
        size = high - low
        is_turned = min(room / size[::-1]) > min(room / size)
        # Columns: what a metre along world x and along world y is on the picture, y downwards.
        axes = np.array([(0.0, -1.0), (-1.0, 0.0)]) if is_turned else np.array([(1.0, 0.0), (0.0, -1.0)])
        self.scale = float(min(room / (size[::-1] if is_turned else size)))
        self.axes = self.scale * axes
        self.offset = 0.5 * PIXEL * np.array([WIDTH, HEIGHT + BAR_HEIGHT]) - self.axes @ (0.5 * (low + high))

    def pixels(self, points_w: np.ndarray) -> np.ndarray:
        """Return where points (..., >=2), world, m, are on the canvas, (..., 2)."""
        return points_w[..., :2] @ self.axes.T + self.offset

    def _pairs(self, points_w: np.ndarray) -> list[tuple[float, float]]:
        return [(x, y) for x, y in self.pixels(points_w).tolist()]

    def _draw_course(self, low: np.ndarray, high: np.ndarray) -> None:
        draw = ImageDraw.Draw(self.empty)
        for line in ground_grid(low[:2], high[:2], GRID_M * np.ceil((high - low)[:2].max() / WIDE_M)):
            draw.line(self._pairs(line), scene.GRID, PIXEL)
        corners = np.array([low[:2], (high[0], low[1]), high[:2], (low[0], high[1]), low[:2]])
        draw.line(self._pairs(corners), scene.BOUNDS, PIXEL)
        for index, (centre, forward) in enumerate(zip(self.gates.centres, self.gates.forward, strict=True)):
            self._draw_gate(draw, index, scene.GATE)
            left = np.array([-forward[1], forward[0]]) / max(np.hypot(forward[0], forward[1]), 1e-6)
            outwards = left if left @ (centre - 0.5 * (low + high))[:2] >= 0.0 else -left
            distance = self.enlargement * self.half_edges_m[index] + LABEL_DISTANCE * self.pixel_m
            (place,) = self._pairs((centre[:2] + distance * outwards)[None])
            draw.text(place, str(index), scene.TEXT, font(13 * PIXEL), anchor="mm")

    def _draw_gate(self, draw: ImageDraw.ImageDraw, index: int, colour: Colour) -> None:
        """Draw a gate as a bar with a gap where its opening is, and an arrow in its direction of flight."""
        middle = self.gates.centres[index]
        for corners, shade, width in (
            (self.gates.outer[index], colour, 4),
            (self.gates.inner[index], scene.BACKGROUND, 2),
        ):
            draw.line(self._pairs(middle + self.enlargement * (corners - middle)), shade, width * PIXEL)
        centre, arrow = middle[:2], ARROW * self.pixel_m * self.gates.forward[index, :2]
        base, across = centre + 0.6 * arrow, 0.25 * np.array([-arrow[1], arrow[0]])
        draw.line(self._pairs(np.array([centre, base])), colour, PIXEL)
        draw.polygon(self._pairs(np.array([centre + arrow, base + across, base - across])), colour)

    def draw(self, log: FlightLog) -> np.ndarray:
        """Return a picture of the log's last row and the way there, (540, 960, 3), uint8.

        Raises:
            ValueError: an empty log.
        """
        if len(log.rows) == 0:
            raise ValueError("log: found no rows, expected at least one")
        canvas = self._extend_trail(log).copy()
        draw = ImageDraw.Draw(canvas)
        row = log.rows[-1].astype(float)
        self._draw_gate(draw, int(row[GATE_INDEX]), scene.NEXT_GATE)
        nose = rotations(row[QUATERNION])[:2, 0] @ self.axes.T
        angle = np.arctan2(nose[1], nose[0])
        turn = np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])
        shape = DRONE_LENGTH * PIXEL * ARROWHEAD @ turn + self.pixels(row[POSITION])
        outline = [(x, y) for x, y in shape.tolist()]
        draw.polygon(outline, scene.DRONE, outline=scene.BACKGROUND, width=PIXEL)
        picture = canvas.reduce(PIXEL)
        self._write(ImageDraw.Draw(picture), log)
        return np.array(picture)

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

    def _write(self, draw: ImageDraw.ImageDraw, log: FlightLog) -> None:
        """Write lap, gate, height, speed, battery and lap times above the course."""
        row = log.rows[-1].astype(float)
        texts = (
            f"lap {row[LAPS] + 1:.0f}",
            f"next gate {row[GATE_INDEX]:.0f}",
            f"height {row[POSITION][2]:.1f} m",
            f"{np.linalg.norm(row[VELOCITY]):.1f} m/s",
            f"{row[BATTERY]:.2f} V",
            f"lap time {log.time_s - row[LAP_START]:.2f} s",
            f"last {row[LAP_TIME]:.2f} s" if row[LAP_TIME] > 0.0 else "",
        )
        for column, text in enumerate(texts):
            draw.text((TEXT_LEFT + column * WIDTH // len(texts), TEXT_TOP), text, scene.TEXT, font(TEXT_SIZE))
