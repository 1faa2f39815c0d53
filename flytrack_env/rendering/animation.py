"""Laps side by side as an animated GIF, seen from a fixed point above the course."""

import io
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from flytrack_env import scene
from flytrack_env.rendering.camera import Camera, unit
from flytrack_env.rendering.views import PIXEL, Floor, draw_drone, draw_gate, font
from flytrack_env.scene import Colour, gates_of
from flytrack_env.state import POSITION, QUATERNION
from flytrack_env.tracks import Course

WIDTH, HEIGHT = 840, 480  # pixels
MARGIN = 24
HEADER = 44  # for the lap times
STEPS_PER_FRAME = 6  # of 0.01 s; GIFs count in 10 ms
LAST_FRAME_MS = 1500
AZIMUTH_DEG, ELEVATION_DEG = (
    20.0,
    36.0,
)  # of the eye: from the course's broad side, and above the ground
DISTANCE = 1.1  # of the eye from the middle, in sizes of the course
DRONE_ENLARGEMENT = 5.0
GRID_M = 5.0
RECENT_STEPS = 50  # of the path that are bright
GATE_COLOUR = scene.blend(scene.NEXT_GATE, scene.BACKGROUND, 0.25)
TEXT_SIZE, GATE_TEXT_SIZE = 22, 16
NUM_COLOURS, NUM_SAMPLED = 128, 8  # colours, and frames that they are chosen from


class Lap(NamedTuple):
    """A lap to show.

    Attributes:
        states: (T, 21), at 100 Hz from the start of the lap on.
        time_s: the lap time, s.
    """

    label: str
    colour: Colour
    states: np.ndarray
    time_s: float


def make_gif(course: Course, gate_ids: Sequence[int], laps: Sequence[Lap]) -> bytes:
    """Return laps as an animated GIF, 840 x 480 pixels, at the speed at which they were flown."""
    view = FixedView(course, gate_ids, laps)
    last = max(len(lap.states) for lap in laps) - 1
    rows = [*range(0, last, STEPS_PER_FRAME), last]
    frames = [view.draw(laps, row) for row in rows]
    return save_gif(frames, 10 * STEPS_PER_FRAME)


def save_gif(frames: Sequence[Image.Image], frame_ms: int) -> bytes:
    """Return pictures as an animated GIF; each is shown that long, ms, the last one longer."""
    sampled = frames[:: -(-len(frames) // NUM_SAMPLED)]
    sheet = Image.new("RGB", (sampled[0].width, len(sampled) * sampled[0].height))
    for index, frame in enumerate(sampled):
        sheet.paste(frame, (0, index * frame.height))
    palette = sheet.quantize(NUM_COLOURS, dither=Image.Dither.NONE)
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations_ms = [frame_ms] * (len(frames) - 1) + [LAST_FRAME_MS]
    content = io.BytesIO()
    indexed[0].save(
        content,
        "GIF",
        save_all=True,
        append_images=indexed[1:],
        duration=durations_ms,
        loop=0,
        optimize=True,
    )
    return content.getvalue()


class FixedView:
    """Draws laps on a course seen from a fixed point, so far off that all of it fits."""

    def __init__(self, course: Course, gate_ids: Sequence[int], laps: Sequence[Lap]):
        self.gates, self.gate_ids = gates_of(course), gate_ids
        self.floor = Floor(course, GRID_M)
        paths_w = np.concatenate([lap.states[:, POSITION] for lap in laps])
        shown_w = np.concatenate([self.gates.outer.reshape(-1, 3), paths_w])
        self.camera = self._fit(shown_w)

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
        points_px = at_one.pixels(at_one.look(points_w))
        room = PIXEL * (np.array([WIDTH, HEIGHT - HEADER]) - 2 * MARGIN)
        focal_px = float((room / np.ptp(points_px, axis=0)).min())
        centre_px = PIXEL * np.array([0.5 * WIDTH, 0.5 * (HEIGHT + HEADER)])
        centre_px -= 0.5 * focal_px * (points_px.min(axis=0) + points_px.max(axis=0))
        return Camera(eye_w, -outwards, centre_px, focal_px)

    def draw(self, laps: Sequence[Lap], row: int) -> Image.Image:
        """Return the picture at a row of the laps: the paths so far, the drones, the lap times."""
        canvas = Image.new("RGB", (PIXEL * WIDTH, PIXEL * HEIGHT), scene.BACKGROUND)
        draw = ImageDraw.Draw(canvas)
        self.floor.draw(draw, self.camera)
        gates_c = self.camera.look(np.concatenate([self.gates.outer, self.gates.inner], axis=1))
        for index in np.argsort(-gates_c[:, :, 2].mean(axis=1)):
            draw_gate(draw, self.camera, gates_c[index], GATE_COLOUR)
            corners_px = self.camera.pixels(gates_c[index])
            label_px = (float(corners_px[:, 0].mean()), float(corners_px[:, 1].min()) - 4 * PIXEL)
            text = str(self.gate_ids[index])
            draw.text(label_px, text, scene.TEXT, font(GATE_TEXT_SIZE * PIXEL), anchor="ms")
        for lap in laps:
            path_w = lap.states[: max(row, 1) + 1, POSITION].astype(float)
            dim = scene.blend(lap.colour, scene.GROUND, 0.45)
            shadow_w = np.where([True, True, False], path_w, self.floor.height_m)
            draw.line(self._pixels(shadow_w), scene.SHADOW, PIXEL)
            draw.line(self._pixels(path_w), dim, 3 * PIXEL, joint="curve")
            draw.line(self._pixels(path_w[-RECENT_STEPS:]), lap.colour, 5 * PIXEL, joint="curve")
        for lap in laps:
            state = lap.states[min(row, len(lap.states) - 1)].astype(float)
            colours = (lap.colour, scene.blend(lap.colour, scene.TEXT, 0.6), lap.colour)
            draw_drone(
                draw, self.camera, state[POSITION], state[QUATERNION], colours, DRONE_ENLARGEMENT
            )
        picture = canvas.reduce(PIXEL)
        self._write(ImageDraw.Draw(picture), laps, row)
        return picture

    def _pixels(self, points_w: np.ndarray) -> list[float]:
        return self.camera.pixels(self.camera.look(points_w)).ravel().tolist()

    def _write(self, draw: ImageDraw.ImageDraw, laps: Sequence[Lap], row: int) -> None:
        """Write the laps' labels and their times so far, from left to right."""
        left = MARGIN
        for lap in laps:
            is_over = row >= len(lap.states) - 1
            text = f"{lap.time_s:.3f} s" if is_over else f"{0.01 * row:.2f} s"
            draw.text((left, 10), lap.label, lap.colour, font(TEXT_SIZE))
            indent = draw.textlength(lap.label, font(TEXT_SIZE)) + 10
            draw.text(
                (left + indent, 10),
                text,
                scene.TEXT if is_over else scene.FAINT_TEXT,
                font(TEXT_SIZE),
            )
            left += WIDTH // 2
