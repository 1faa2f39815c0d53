"""The flight from behind the drone, in perspective: gates, ground, trail and drone."""

import numpy as np
from PIL import Image, ImageDraw

from flytrack_env.rendering import palette
from flytrack_env.rendering.camera import Camera
from flytrack_env.rendering.geometry import UP_W, Gates, ground_grid, rotation, unit
from flytrack_env.rendering.scene import GATE_INDEX, FlightLog
from flytrack_env.state import POSITION, QUATERNION, VELOCITY
from flytrack_env.tracks import Course

FIELD_OF_VIEW_DEG = 80.0
BEHIND_M = 2.0
ABOVE_M = 0.65
LOWEST_M = 0.25  # above the floor
LOOK_AHEAD_M = 5.0
AIM_BEYOND_M = 3.0  # beyond the gate's centre, so that the aim does not whirl round in passing
SWING_STEPS = 25.0  # the camera follows what it aims at with this time constant
MEMORY_STEPS = 100
TRAIL_STEPS = 150
GRID_M = 2.0
HAZE_M = 60.0  # at this distance half of a gate's colour is the sky's
NUMBER_M = 0.6  # height of a gate's number
NUMBER_NEAREST_M = 1.0

# Body frame, m. Front left, front right, back left, back right.
ARM_M = 0.13
MOTORS_B = ARM_M * np.array([(1.0, 1.0, 0.0), (1.0, -1.0, 0.0), (-1.0, 1.0, 0.0), (-1.0, -1.0, 0.0)])
ROTOR_M = 0.09
BODY_M = 0.05
SHADOW_M = 0.2
ANGLES = np.linspace(0.0, 2.0 * np.pi, 14, endpoint=False)
CIRCLE = np.stack([np.cos(ANGLES), np.sin(ANGLES), np.zeros(14)], axis=-1)


class ChaseView:
    """Draws the view into a canvas from a left edge on.

    left: pixels of the canvas that belong to another view. width, height: of this one.
    """

    def __init__(self, course: Course, gates: Gates, left: int, width: int, height: int):
        self.gates, self.left, self.width, self.height = gates, left, width, height
        self.corners_w = np.concatenate([gates.outer, gates.inner], axis=1)
        self.tops_w = gates.centres + UP_W * (0.5 * np.ptp(gates.outer[..., 2:], axis=1) + 0.7 * NUMBER_M)
        self.focal_px = 0.5 * width / np.tan(0.5 * np.radians(FIELD_OF_VIEW_DEG))
        self.centre_px = np.array([0.5 * width, 0.5 * height])
        self.pixel = palette.SUPERSAMPLING
        low, high = (np.array(corner, float) for corner in (course.bounds_low, course.bounds_high))
        self.floor_m = low[2]
        self.grid_w = ground_grid(low, high, GRID_M)
        self.backdrop = self._make_backdrop()

    def _make_backdrop(self) -> Image.Image:
        """Return sky above ground, three views high, to be shifted with the horizon."""
        sky = np.linspace(palette.SKY_TOP, palette.SKY_HORIZON, self.height)
        zenith = np.tile(sky[:1], (self.height // 2, 1))
        ground = np.tile([palette.GROUND], (3 * self.height // 2, 1))
        column = np.round(np.concatenate([zenith, sky, ground])).astype(np.uint8)
        return Image.fromarray(np.tile(column[:, None], (1, self.width, 1)))

    def camera(self, rows: np.ndarray) -> Camera:
        """Return the camera behind the drone of the last row, looking to where the next gate is.

        It follows slowly: its direction is the mean over the last rows, the latest weighing most.
        """
        recent = rows[-MEMORY_STEPS:].astype(float)
        index = recent[:, GATE_INDEX].astype(int)
        aims_w = self.gates.centres[index] + AIM_BEYOND_M * self.gates.forward[index]
        ways_w = aims_w - recent[:, POSITION]
        ways_w /= np.maximum(np.linalg.norm(ways_w, axis=1, keepdims=True), 1e-6)
        weights = np.exp(np.arange(1 - len(ways_w), 1) / SWING_STEPS)
        direction = unit(weights @ ways_w, self.gates.forward[index[-1]])
        # Half the slope, so that the horizon stays in sight.
        direction = unit(direction * np.array([1.0, 1.0, 0.5]), np.array([1.0, 0.0, 0.0]))
        drone_w = recent[-1, POSITION]
        eye_w = drone_w - BEHIND_M * direction + ABOVE_M * UP_W
        eye_w[2] = max(eye_w[2], self.floor_m + LOWEST_M)
        forward = unit(drone_w + LOOK_AHEAD_M * direction - eye_w, direction)
        return Camera(eye_w, forward, self.centre_px, self.focal_px)

    def draw(self, canvas: Image.Image, log: FlightLog) -> None:
        """Draw the view of the log's last row."""
        row = log.rows[-1].astype(float)
        camera = self.camera(log.rows)
        top = int(np.clip(1.5 * self.height - camera.horizon_px(), 0, 2 * self.height))
        picture = self.backdrop.crop((0, top, self.width, top + self.height))
        draw = ImageDraw.Draw(picture)
        self._draw_ground(draw, camera, row[POSITION])
        distances_m = np.linalg.norm(self.gates.centres - camera.eye_w, axis=1)
        is_beyond = distances_m > np.linalg.norm(row[POSITION] - camera.eye_w)
        corners_c, next_index = camera.look(self.corners_w), int(row[GATE_INDEX])
        order = np.argsort(-distances_m)
        for index in order[is_beyond[order]]:
            self._draw_gate(draw, camera, index, next_index, corners_c[index])
        self._draw_trail(draw, camera, log.rows)
        self._draw_drone(draw, camera, row)
        for index in order[~is_beyond[order]]:
            # An outline only, so that the drone is seen through it.
            self._draw_outline(draw, camera, corners_c[index], self._colour(index, next_index))
        canvas.paste(picture, (self.left, 0))

    def _draw_ground(self, draw: ImageDraw.ImageDraw, camera: Camera, drone_w: np.ndarray) -> None:
        for line in camera.segments(self.grid_w)[0]:
            draw.line(line, palette.GROUND_GRID, self.pixel)
        below = np.array([drone_w[0], drone_w[1], self.floor_m])
        shadow = camera.polygon(camera.look(below + SHADOW_M * CIRCLE))
        if shadow:
            draw.polygon(shadow, palette.SHADOW)

    def _colour(self, index: int, next_index: int) -> palette.Colour:
        if index == next_index:
            return palette.NEXT_GATE
        is_after = index == (next_index + 1) % len(self.gates.centres)
        return palette.GATE_AFTER if is_after else palette.GATE

    def _draw_gate(
        self, draw: ImageDraw.ImageDraw, camera: Camera, index: int, next_index: int, corners_c: np.ndarray
    ) -> None:
        """Draw a gate's frame as a solid ring with its number above; corners: outer four, inner four."""
        distance_m = float(np.linalg.norm(corners_c[:4].mean(axis=0)))
        haze = distance_m / (distance_m + HAZE_M)
        colour = palette.blend(self._colour(index, next_index), palette.SKY_HORIZON, haze)
        for a in range(4):
            b = (a + 1) % 4
            side = camera.polygon(corners_c[[a, b, 4 + b, 4 + a]])
            if side:
                draw.polygon(side, colour)
        self._draw_outline(draw, camera, corners_c, palette.blend(colour, palette.BACKGROUND, 0.6))
        top_c = camera.look(self.tops_w[index])
        if top_c[2] > NUMBER_NEAREST_M:
            # In steps, so that few sizes are set.
            size = 4 * int(np.clip(NUMBER_M * self.focal_px / top_c[2], 24, 80) // 4)
            number = palette.lettering(str(index), size)
            corner = camera.pixels(top_c) - 0.5 * np.array(number.size)
            draw.bitmap((round(corner[0]), round(corner[1])), number, colour)

    def _draw_outline(
        self, draw: ImageDraw.ImageDraw, camera: Camera, corners_c: np.ndarray, colour: palette.Colour
    ) -> None:
        for square_c in (corners_c[:4], corners_c[4:]):
            outline = camera.polygon(square_c)
            if outline:
                draw.line(outline + outline[:2], colour, self.pixel)

    def _draw_trail(self, draw: ImageDraw.ImageDraw, camera: Camera, rows: np.ndarray) -> None:
        recent = rows[-TRAIL_STEPS:].astype(float)
        points_w = recent[:, POSITION]
        colours = palette.speed_colours(np.linalg.norm(recent[1:, VELOCITY], axis=1))
        lines, indices = camera.segments(np.stack([points_w[:-1], points_w[1:]], axis=1))
        for line, index in zip(lines, indices, strict=True):
            draw.line(line, colours[index], 2 * self.pixel)

    def _draw_drone(self, draw: ImageDraw.ImageDraw, camera: Camera, row: np.ndarray) -> None:
        """Draw arms, rotors and body, the far rotors first; the front ones are red."""
        to_world, drone_w = rotation(row[QUATERNION]), row[POSITION]
        motors_w = drone_w + MOTORS_B @ to_world.T
        for line in camera.segments(np.stack([motors_w[:2], motors_w[:1:-1]], axis=1))[0]:
            draw.line(line, palette.DRONE, 4 * self.pixel)
        disc_w = ROTOR_M * CIRCLE @ to_world.T
        body_w = drone_w + BODY_M * (CIRCLE @ np.stack([camera.axes[0], camera.axes[1], UP_W]))
        parts = [(motor_w + disc_w, palette.FRONT_ROTOR) for motor_w in motors_w[:2]]
        parts += [(motor_w + disc_w, palette.REAR_ROTOR) for motor_w in motors_w[2:]]
        parts += [(body_w, palette.DRONE)]
        looked = [(camera.look(points_w), colour) for points_w, colour in parts]
        for points_c, colour in sorted(looked, key=lambda part: -part[0][:, 2].mean()):
            rim = camera.polygon(points_c)
            if rim:
                draw.polygon(rim, colour, outline=palette.BACKGROUND, width=self.pixel)
