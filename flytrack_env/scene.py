"""What pictures, videos, windows and recordings share: shapes, the drone's body, colours."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flytrack_env.quaternion import Scalar
from flytrack_env.tracks import Course

Colour = tuple[int, int, int]

# On white: colours of M. Okabe and K. Ito, which colour-blind readers can tell apart.
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"
PAPER_COLOURS = (BLUE, ORANGE, GREEN, "#CC79A7", "#E69F00", "#56B4E9", "#000000")
PAPER_FRAME, PAPER_OPENING = "0.25", "tab:red"

# On dark ground.
BACKGROUND: Colour = (20, 24, 31)
GRID: Colour = (38, 45, 57)
BOUNDS: Colour = (66, 76, 92)
SKY: Colour = (82, 104, 134)
GROUND: Colour = (34, 40, 48)
GROUND_GRID: Colour = (58, 67, 80)
SHADOW: Colour = (14, 17, 22)
GATE: Colour = (150, 160, 175)
NEXT_GATE: Colour = (255, 140, 0)
DRONE: Colour = (255, 255, 255)
FRONT_ROTOR: Colour = (255, 70, 70)
REAR_ROTOR: Colour = (225, 230, 238)
CAMERA: Colour = (80, 200, 255)
TEXT: Colour = (235, 239, 245)
FAINT_TEXT: Colour = (150, 160, 175)
FLIGHT_COLOURS: tuple[Colour, ...] = (
    (120, 220, 120),
    (90, 160, 255),
    (240, 110, 200),
    (240, 220, 90),
    (100, 220, 220),
    (200, 160, 255),
)
# Blue, cyan, green, yellow, red: slow to fast.
SPEED_STOPS = np.array(
    [(70, 110, 255), (60, 200, 240), (80, 220, 110), (250, 215, 60), (255, 70, 60)]
)
FASTEST_M_S = 20.0  # and above: the last of the speed colours
NUM_SPEED_COLOURS = 64

UP_W = np.array([0.0, 0.0, 1.0])
SQUARE = ((-1, -1), (1, -1), (1, 1), (-1, 1))  # corners in order around it
# Body frame, m: x forward, y left, z up. Motors: front left, front right, back left, back right.
MOTORS_B = np.array(
    [(0.15, 0.09, 0.0), (0.15, -0.09, 0.0), (-0.15, 0.14, 0.0), (-0.15, -0.14, 0.0)]
)
ARMS_B = MOTORS_B[[[0, 3], [1, 2]]]
ROTOR_M = 0.08  # radius


class Gates(NamedTuple):
    """The gates of a course in flying order, world frame, m.

    Attributes:
        centres, forward: (n, 3); forward is the direction of flight.
        outer, inner: (n, 4, 3), the corners of frame and opening, in order around the square.
    """

    centres: np.ndarray
    forward: np.ndarray
    outer: np.ndarray
    inner: np.ndarray


def gates_of(course: Course) -> Gates:
    """Return the gates of a course as arrays."""
    frames = course.gates
    centres, forward, up = (
        np.stack([np.asarray(component, float) for component in vector], axis=-1)
        for vector in (frames.centre, frames.forward, frames.up)
    )
    left = np.cross(up, forward)

    def corners(half_edge: Scalar) -> np.ndarray:
        half = np.asarray(half_edge, float)[:, None]
        return np.stack([centres + half * (a * left + b * up) for a, b in SQUARE], axis=1)

    return Gates(centres, forward, corners(frames.half_frame), corners(frames.half_opening))


def rotations(quaternions: np.ndarray) -> np.ndarray:
    """Return rotations (..., 3, 3), body to world, of unit quaternions (..., 4), scalar first."""
    return Rotation.from_quat(quaternions, scalar_first=True).as_matrix()


def ground_grid(low: np.ndarray, high: np.ndarray, spacing_m: float) -> np.ndarray:
    """Return the lines of a grid on the floor of a box from low to high, (n, 2, 3), world, m."""
    lines = []
    for axis, other in ((0, 1), (1, 0)):
        first, last = np.ceil(low[axis] / spacing_m), np.floor(high[axis] / spacing_m)
        for offset in spacing_m * np.arange(first, last + 1):
            line = np.full((2, 3), low[2])
            line[:, axis] = offset
            line[:, other] = low[other], high[other]
            lines.append(line)
    return np.array(lines).reshape(-1, 2, 3)


def speed_colours(speeds_m_s: np.ndarray) -> list[Colour]:
    """Return the trail's colour at each speed (n,), m/s."""
    steps = np.clip(
        speeds_m_s * (NUM_SPEED_COLOURS / FASTEST_M_S), 0, NUM_SPEED_COLOURS - 1
    ).astype(int)
    positions = np.linspace(0.0, len(SPEED_STOPS) - 1.0, NUM_SPEED_COLOURS)[steps]
    channels = [
        np.interp(positions, np.arange(len(SPEED_STOPS)), channel) for channel in SPEED_STOPS.T
    ]
    return [(int(r), int(g), int(b)) for r, g, b in zip(*channels, strict=True)]


def blend(colour: Colour, other: Colour, share: float) -> Colour:
    """Return a colour with that share, 0 to 1, of another one."""
    r, g, b = (round(a + (o - a) * share) for a, o in zip(colour, other, strict=True))
    return r, g, b
