"""The whole course from above, with the trail of the flight and the drone as an arrow."""

from weakref import WeakKeyDictionary

import numpy as np
from PIL import Image, ImageDraw

from flytrack_env.rendering import palette
from flytrack_env.rendering.geometry import Gates, ground_grid, rotation
from flytrack_env.rendering.scene import GATE_INDEX, FlightLog
from flytrack_env.state import POSITION, QUATERNION, VELOCITY
from flytrack_env.tracks import Course

MARGIN = 28  # pixels around the bounds, before supersampling; room for the legend
GRID_M = 5.0
WIDE_M = 60.0  # a course of more than this, or of more than twice, has a grid that much wider
# Pixels, before supersampling.
SMALLEST_GATE = 26  # gates of a wide course are drawn larger than they are
LABEL_DISTANCE = 11  # from the frame's edge
LABELS_APART = 15
ARROW = 18
DRONE_LENGTH = 20
# The drone's arrow, nose at +x, in units of its length.
ARROWHEAD = np.array([(0.6, 0.0), (-0.4, 0.38), (-0.2, 0.0), (-0.4, -0.38)])


class TopView:
    """Draws the view into the left of a canvas; trails are kept from picture to picture.

    width, height: pixels of the canvas's part.
    """

    def __init__(self, course: Course, gates: Gates, width: int, height: int):
        self.gates = gates
        self.pixel = palette.SUPERSAMPLING
        low, high = (np.array(corner, float) for corner in (course.bounds_low, course.bounds_high))
        self._fit(low[:2], high[:2], width, height)
        self.half_edges_m = 0.5 * np.linalg.norm(gates.outer[:, 1] - gates.outer[:, 0], axis=1)
        self.pixel_m = self.pixel / self.scale
        self.enlargement = max(1.0, SMALLEST_GATE * self.pixel_m / (2.0 * self.half_edges_m.min()))
        self.empty = Image.new("RGB", (width, height), palette.BACKGROUND)
        self._draw_course(course, low, high)
        self._draw_legend(width, height)
        # The trail of each flight that was drawn, and how many of its rows are in it.
        self.trails: WeakKeyDictionary[FlightLog, tuple[Image.Image, int]] = WeakKeyDictionary()

    def _fit(self, low: np.ndarray, high: np.ndarray, width: int, height: int) -> None:
        """Choose scale and orientation: world x to the right, or upwards where that is larger."""
        room = np.array([width, height]) - 2 * MARGIN * self.pixel
        size = high - low
        is_turned = min(room / size[::-1]) > min(room / size)
        # Columns: what a metre along world x and along world y is on the picture, y downwards.
        axes = np.array([(0.0, -1.0), (-1.0, 0.0)]) if is_turned else np.array([(1.0, 0.0), (0.0, -1.0)])
        self.scale = float(min(room / (size[::-1] if is_turned else size)))
        self.axes = self.scale * axes
        self.offset = 0.5 * np.array([width, height]) - self.axes @ (0.5 * (low + high))

    def pixels(self, points_w: np.ndarray) -> np.ndarray:
        """Return where points (..., >=2), world, m, are on the picture, (..., 2)."""
        return points_w[..., :2] @ self.axes.T + self.offset

    def _flat(self, points_w: np.ndarray) -> list[tuple[float, float]]:
        return [(x, y) for x, y in self.pixels(points_w).tolist()]

    def _draw_course(self, course: Course, low: np.ndarray, high: np.ndarray) -> None:
        draw = ImageDraw.Draw(self.empty)
        spacing_m = GRID_M * np.ceil((high - low)[:2].max() / WIDE_M)
        for line in ground_grid(low, high, spacing_m):
            draw.line(self._flat(line), palette.GRID, self.pixel)
        corners = np.array([low[:2], (high[0], low[1]), high[:2], (low[0], high[1]), low[:2]])
        draw.line(self._flat(corners), palette.BOUNDS, self.pixel)
        start = self.pixels(np.array(course.start_pos_w, float))
        radius = 4 * self.pixel
        draw.ellipse([*(start - radius), *(start + radius)], outline=palette.FAINT_TEXT, width=self.pixel)
        labels: list[np.ndarray] = []
        font = palette.font(13 * self.pixel)
        for index in range(len(self.gates.centres)):
            self._draw_gate(draw, index, palette.GATE)
            place = self._label_place(index, labels, 0.5 * (low + high)[:2])
            labels.append(place)
            draw.text(self._flat(place[None])[0], str(index), palette.TEXT, font, anchor="mm")

    def _label_place(self, index: int, taken: list[np.ndarray], middle: np.ndarray) -> np.ndarray:
        """Return a place (2,), world, beside a gate: away from the middle, unless another label is there."""
        centre = self.gates.centres[index, :2]
        side = np.array([-self.gates.forward[index, 1], self.gates.forward[index, 0]])
        side = side / max(np.linalg.norm(side), 1e-6)
        outwards = side if side @ (centre - middle) >= 0.0 else -side
        distance = self.enlargement * self.half_edges_m[index] + LABEL_DISTANCE * self.pixel_m
        places = [centre + distance * outwards, centre - distance * outwards]
        for place in places:
            if all(np.linalg.norm(place - other) > LABELS_APART * self.pixel_m for other in taken):
                return place
        return places[0]

    def _draw_gate(self, draw: ImageDraw.ImageDraw, index: int, colour: palette.Colour) -> None:
        """Draw a gate as a bar with a gap where its opening is, and an arrow in its direction of flight."""
        middle = self.gates.centres[index]
        for corners, shade, width in (
            (self.gates.outer[index], colour, 4),
            (self.gates.inner[index], palette.BACKGROUND, 2),
        ):
            draw.line(self._flat(middle + self.enlargement * (corners - middle)), shade, width * self.pixel)
        centre, arrow = middle[:2], ARROW * self.pixel_m * self.gates.forward[index, :2]
        base, side = centre + 0.6 * arrow, 0.25 * np.array([-arrow[1], arrow[0]])
        head = np.array([centre + arrow, base + side, base - side])
        draw.line(self._flat(np.array([centre, base])), colour, self.pixel)
        draw.polygon(self._flat(head), colour)

    def _draw_legend(self, width: int, height: int) -> None:
        """Draw the trail's colours with their speeds below the course."""
        draw, font = ImageDraw.Draw(self.empty), palette.font(11 * self.pixel)
        left, right, bar = 0.3 * width, 0.7 * width, 5 * self.pixel
        top = height - 15 * self.pixel
        edges = np.linspace(left, right, palette.NUM_SPEED_COLOURS + 1)
        for colour, start, end in zip(palette.SPEED_COLOURS, edges, edges[1:], strict=False):
            draw.rectangle([start, top, end, top + bar], colour)
        middle, gap = top + 0.5 * bar, 8 * self.pixel
        draw.text((left - gap, middle), "0", palette.FAINT_TEXT, font, anchor="rm")
        text = f"{palette.FASTEST_M_S:g} m/s"
        draw.text((right + gap, middle), text, palette.FAINT_TEXT, font, anchor="lm")

    def draw(self, canvas: Image.Image, log: FlightLog) -> None:
        """Draw the view of the log's last row, and the trail of all of them, at the canvas's left."""
        canvas.paste(self._extend_trail(log), (0, 0))
        draw = ImageDraw.Draw(canvas)
        row = log.rows[-1].astype(float)
        self._draw_gate(draw, int(row[GATE_INDEX]), palette.NEXT_GATE)
        nose = (rotation(row[QUATERNION]) @ np.array([1.0, 0.0, 0.0]))[:2] @ self.axes.T
        angle = np.arctan2(nose[1], nose[0])
        turn = np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])
        shape = DRONE_LENGTH * self.pixel * ARROWHEAD @ turn + self.pixels(row[POSITION])
        outline = [(x, y) for x, y in shape.tolist()]
        draw.polygon(outline, palette.DRONE, outline=palette.BACKGROUND, width=self.pixel)

    def _extend_trail(self, log: FlightLog) -> Image.Image:
        """Return the course with the trail; only what was flown since the last picture is drawn."""
        picture, num_drawn = self.trails.get(log) or (self.empty.copy(), 0)
        new = log.rows[max(num_drawn - 1, 0) :]
        draw = ImageDraw.Draw(picture)
        points = self._flat(new[:, POSITION])
        colours = palette.speed_colours(np.linalg.norm(new[1:, VELOCITY], axis=1))
        for start, end, colour in zip(points, points[1:], colours, strict=False):
            draw.line([start, end], colour, 2 * self.pixel)
        self.trails[log] = picture, len(log.rows)
        return picture
