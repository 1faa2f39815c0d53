"""Laps side by side as an animated GIF, seen from a fixed point above the course."""

import io
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from flytrack_env import scene
from flytrack_env.rendering.camera import Camera, unit
from flytrack_env.rendering.views import PIXEL, draw_drone, font
from flytrack_env.scene import Colour, gates_of, ground_grid
from flytrack_env.state import POSITION, QUATERNION
from flytrack_env.tracks import Course

WIDTH, HEIGHT = 480, 300  # pixels
MARGIN = 14
HEADER = 26  # for the lap times
STEPS_PER_FRAME = 6  # of 0.01 s; GIFs count in 10 ms
LAST_FRAME_MS = 1500
AZIMUTH_DEG, ELEVATION_DEG = 20.0, 36.0  # of the eye: from the course's broad side, and above the ground
DISTANCE = 1.1  # of the eye from the middle, in sizes of the course
DRONE_ENLARGEMENT = 5.0
GRID_M = 5.0
PIECE_STEPS, RECENT_STEPS = 4, 50
TEXT_SIZE = 14
NUM_COLOURS = 128


class Lap(NamedTuple):
    """A lap to show: label and colour, states (T, 21) at 100 Hz from the start of the lap on, lap time, s."""

    label: str
    colour: Colour
    states: np.ndarray
    time_s: float

    def at(self, row: int) -> np.ndarray:
        """Return the state at a row, or the last one, (21,)."""
        return self.states[min(row, len(self.states) - 1)].astype(float)


class Shape(NamedTuple):
    """A polygon, or with a width (pixels) a line; distance_m: from the eye, by which shapes are ordered."""

    distance_m: float
    outline: list[float]
    colour: Colour
    width: int = 0


def make_gif(course: Course, laps: Sequence[Lap]) -> bytes:
    """Return laps as an animated GIF, 480 x 300 pixels, at the speed at which they were flown."""
    view = FixedView(course, laps)
    last = max(len(lap.states) for lap in laps) - 1
    rows = [*range(0, last, STEPS_PER_FRAME), last]
    frames = [view.draw(laps, row) for row in rows]
    palette = frames[-1].quantize(NUM_COLOURS, dither=Image.Dither.NONE)
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations_ms = [10 * STEPS_PER_FRAME] * (len(rows) - 1) + [LAST_FRAME_MS]
    content = io.BytesIO()
    indexed[0].save(
        content, "GIF", save_all=True, append_images=indexed[1:], duration=durations_ms, loop=0, optimize=True
    )
    return content.getvalue()


class FixedView:
    """Draws laps on a course that is seen from a fixed point: the eye is far off, so that all of it fits."""

    def __init__(self, course: Course, laps: Sequence[Lap]):
        self.gates = gates_of(course)
        low, high = (np.array(corner, float) for corner in (course.bounds_low, course.bounds_high))
        paths_w = np.concatenate([lap.states[:, POSITION] for lap in laps])
        shown_w = np.concatenate([self.gates.outer.reshape(-1, 3), paths_w])
        self.floor_m = low[2]
        self.camera = self._fit(shown_w)
        self.grid_w = ground_grid(low, high, GRID_M)
        corners = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
        self.floor_w = np.array([(x, y, low[2]) for x, y in corners])
        self.farthest_w = max(self.gates.centres, key=self._distance_m)

    def _fit(self, points_w: np.ndarray) -> Camera:
        """Return a camera that sees all of these points, as large as they fit."""
        low, high = points_w.min(axis=0), points_w.max(axis=0)
        middle, size = 0.5 * (low + high), high - low
        azimuth = np.radians(AZIMUTH_DEG + (0.0 if size[1] > size[0] else -90.0))
        elevation = np.radians(ELEVATION_DEG)
        outwards = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
        outwards = unit(outwards, scene.UP_W)
        eye_w = middle + DISTANCE * np.linalg.norm(size) * outwards
        at_one = Camera(eye_w, -outwards, np.zeros(2), 1.0)
        seen = at_one.pixels(at_one.look(points_w))
        room = PIXEL * (np.array([WIDTH, HEIGHT - HEADER]) - 2 * MARGIN)
        focal_px = float((room / np.ptp(seen, axis=0)).min())
        centre_px = PIXEL * np.array([0.5 * WIDTH, 0.5 * (HEIGHT + HEADER)])
        centre_px -= 0.5 * focal_px * (seen.min(axis=0) + seen.max(axis=0))
        return Camera(eye_w, -outwards, centre_px, focal_px)

    def draw(self, laps: Sequence[Lap], row: int) -> Image.Image:
        """Return the picture at a row of the laps: the paths so far, the drones, the lap times."""
        canvas = Image.new("RGB", (PIXEL * WIDTH, PIXEL * HEIGHT), scene.BACKGROUND)
        draw = ImageDraw.Draw(canvas)
        draw.polygon(self.camera.polygon(self.camera.look(self.floor_w)), scene.GROUND)
        for line in self.camera.look(self.grid_w):
            draw.line(self.camera.polygon(line), scene.GROUND_GRID, PIXEL)
        shapes = [self._shadow(lap, row) for lap in laps]
        solids = self._beams() + [shape for lap in laps for shape in self._path(lap, row)]
        shapes += sorted(solids, key=lambda shape: -shape.distance_m)
        for shape in shapes:
            if shape.width:
                draw.line(shape.outline, shape.colour, shape.width, joint="curve")
            else:
                draw.polygon(shape.outline, shape.colour)
        for lap in sorted(laps, key=lambda lap: -self._distance_m(lap.at(row)[POSITION])):
            state, rotors = lap.at(row), scene.blend(lap.colour, scene.TEXT, 0.6)
            colours = (lap.colour, rotors, lap.colour)
            draw_drone(draw, self.camera, state[POSITION], state[QUATERNION], colours, DRONE_ENLARGEMENT)
        picture = canvas.reduce(PIXEL)
        self._write(ImageDraw.Draw(picture), laps, row)
        return picture

    def _distance_m(self, point_w: np.ndarray) -> float:
        return float(np.linalg.norm(point_w - self.camera.eye_w))

    def _beams(self) -> list[Shape]:
        """Return the four beams of every gate's frame."""
        found = []
        for corners_w in np.concatenate([self.gates.outer, self.gates.inner], axis=1):
            for a, b in itertools.pairwise((0, 1, 2, 3, 0)):
                beam_w = corners_w[[a, b, 4 + b, 4 + a]]
                distance_m = self._distance_m(beam_w.mean(axis=0))
                haze = 0.3 * distance_m / self._distance_m(self.farthest_w)
                colour = scene.blend(scene.NEXT_GATE, scene.BACKGROUND, haze)
                found.append(Shape(distance_m, self.camera.polygon(self.camera.look(beam_w)), colour))
        return found

    def _pixels(self, points_w: np.ndarray) -> list[float]:
        return self.camera.pixels(self.camera.look(points_w)).ravel().tolist()

    def _shadow(self, lap: Lap, row: int) -> Shape:
        path_w = lap.states[: max(row, 1) + 1, POSITION].astype(float)
        path_w[:, 2] = self.floor_m
        return Shape(np.inf, self._pixels(path_w), scene.SHADOW, PIXEL)

    def _path(self, lap: Lap, row: int) -> list[Shape]:
        """Return the path up to a row in pieces; the last half second is brighter."""
        points_w = lap.states[: row + 1, POSITION].astype(float)
        found = []
        for first in range(0, len(points_w) - 1, PIECE_STEPS):
            piece_w = points_w[first : first + PIECE_STEPS + 1]
            is_recent = first > row - RECENT_STEPS
            colour = lap.colour if is_recent else scene.blend(lap.colour, scene.GROUND, 0.45)
            width = PIXEL * (3 if is_recent else 2)
            found.append(Shape(self._distance_m(piece_w[0]), self._pixels(piece_w), colour, width))
        return found

    def _write(self, draw: ImageDraw.ImageDraw, laps: Sequence[Lap], row: int) -> None:
        """Write the laps' labels and their times so far, from left to right."""
        left = MARGIN
        for lap in laps:
            is_over = row >= len(lap.states) - 1
            text = f"{lap.time_s:.3f} s" if is_over else f"{0.01 * row:.2f} s"
            draw.text((left, 6), lap.label, lap.colour, font(TEXT_SIZE))
            indent = draw.textlength(lap.label, font(TEXT_SIZE)) + 10
            draw.text((left + indent, 6), text, scene.TEXT if is_over else scene.FAINT_TEXT, font(TEXT_SIZE))
            left += WIDTH // 2
