"""A flight from behind, beside what the drone's own camera sees, as an animated GIF."""

import numpy as np
from PIL import Image, ImageDraw

from flytrack_env import camera, scene
from flytrack_env.flown_camera import HEIGHT_PX, WIDTH_PX, Film
from flytrack_env.rendering.animation import save_gif
from flytrack_env.rendering.camera import Camera
from flytrack_env.rendering.flight_log import FlightLog
from flytrack_env.rendering.views import CHASE_GRID_M, PIXEL, ChaseView, Floor, draw_gate
from flytrack_env.scene import gates_of, rotations
from flytrack_env.state import POSITION, QUATERNION
from flytrack_env.tracks import Course

STEPS_PER_FRAME = 6  # of 0.01 s
VIEW_WIDTH, VIEW_HEIGHT = WIDTH_PX * 5 // 8, HEIGHT_PX * 5 // 8  # of each half of a picture
MASK_WIDTH = 96
MARGIN, DOT = 8, 4


class OnboardView:
    """Draws what the drone's camera sees: gates, ground, and the corners that it is given."""

    def __init__(self, course: Course):
        self.gates, self.floor = gates_of(course), Floor(course, CHASE_GRID_M)

    def draw(self, state: np.ndarray, corners_px: np.ndarray, visible: np.ndarray) -> Image.Image:
        """Return the picture of a state (21,); corners and flags as in a row of ``Film``."""
        width, height = PIXEL * VIEW_WIDTH, PIXEL * VIEW_HEIGHT
        picture = Image.new("RGB", (width, height), scene.SKY)
        draw = ImageDraw.Draw(picture)
        view = _onboard_camera(state, width, height)
        self.floor.draw(draw, view)
        gates_c = view.look(np.concatenate([self.gates.outer, self.gates.inner], axis=1))
        for index in np.argsort(-np.linalg.norm(gates_c.mean(axis=1), axis=1)):
            draw_gate(draw, view, gates_c[index], scene.GATE)
        scale = width / WIDTH_PX
        for gate, colour in enumerate((scene.NEXT_GATE, scene.CAMERA)):
            for right, down in scale * corners_px[gate][visible[gate]]:
                reach = DOT * PIXEL
                dot = [right - reach, down - reach, right + reach, down + reach]
                draw.ellipse(dot, colour, outline=scene.BACKGROUND, width=PIXEL)
        return picture.reduce(PIXEL)


def _onboard_camera(state: np.ndarray, width: int, height: int) -> Camera:
    """Return the drone's camera, which tilts with it, for a picture of this size, px."""
    focal_px = 0.5 * width / np.tan(0.5 * np.radians(camera.FIELD_OF_VIEW_DEG))
    x_w, y_w, z_w = rotations(state[QUATERNION]).T
    pitch = np.radians(camera.PITCH_DEG)
    forward_w = np.cos(pitch) * x_w + np.sin(pitch) * z_w
    view = Camera(state[POSITION], forward_w, np.array([0.5 * width, 0.5 * height]), focal_px)
    view.axes = np.stack([-y_w, np.sin(pitch) * x_w - np.cos(pitch) * z_w, forward_w])
    return view


def make_onboard_gif(course: Course, rows: np.ndarray, film: Film) -> bytes:
    """Return a flight as an animated GIF, 800 x 300 pixels, at the speed at which it was flown.

    From behind at the left; at the right what the camera sees, with the corners in it, and the mask
    in a corner.

    Args:
        course: that was flown.
        rows: of the flight's log, (T, SCENE_SIZE).
        film: what the camera saw in each.
    """
    chase = ChaseView(course, gates_of(course), 0, PIXEL * VIEW_WIDTH, PIXEL * VIEW_HEIGHT)
    onboard, log, frames = OnboardView(course), FlightLog(0.01), []
    for index, row in enumerate(rows):
        log.append(row)
        if index % STEPS_PER_FRAME:
            continue
        behind = Image.new("RGB", (PIXEL * VIEW_WIDTH, PIXEL * VIEW_HEIGHT))
        chase.draw(behind, log)
        picture = Image.new("RGB", (2 * VIEW_WIDTH, VIEW_HEIGHT))
        picture.paste(behind.reduce(PIXEL), (0, 0))
        seen = onboard.draw(row.astype(float), film.corners_px[index], film.is_visible[index])
        picture.paste(seen, (VIEW_WIDTH, 0))
        mask = Image.fromarray(film.masks[index]).resize(
            (MASK_WIDTH, MASK_WIDTH), Image.Resampling.NEAREST
        )
        corner_px = 2 * VIEW_WIDTH - MASK_WIDTH - MARGIN, VIEW_HEIGHT - MASK_WIDTH - MARGIN
        picture.paste(mask.convert("RGB"), corner_px)
        frames.append(picture)
    return save_gif(frames, 10 * STEPS_PER_FRAME)
