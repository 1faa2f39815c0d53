"""What a drone's camera saw along recorded states: corners of the next two gates, and masks."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env import camera
from flytrack_env.camera import CameraPose
from flytrack_env.state import unpack
from flytrack_env.tracks import Course, Track, build_course

WIDTH_PX, HEIGHT_PX, MASK_PX = 640, 480, 64


class Film(NamedTuple):
    """What the camera of ``FlyTrackCorners-v0``, and of ``FlyTrackMask-v0``, saw in T states.

    Attributes:
        corners_px: of the gate to fly and the next, right and down of the top left edge of an image
            of 640 x 480, (T, 2, 4, 2).
        is_visible: whether the image shows each, (T, 2, 4).
        masks: (T, 64, 64) uint8, 255 on a frame.
    """

    corners_px: np.ndarray
    is_visible: np.ndarray
    masks: np.ndarray


def film(states: np.ndarray, gate_indices: np.ndarray, track: Track) -> Film:
    """Return what the default cameras saw.

    Args:
        states: (T, 21).
        gate_indices: of the gate to fly in each, (T,).
        track: whose gates are seen.
    """
    course = build_course(track)
    shown = _film(jnp.asarray(states, jnp.float32), jnp.asarray(gate_indices, jnp.int32), course)
    return Film(*map(np.asarray, shown))


@jax.jit
@partial(jax.vmap, in_axes=(0, 0, None))
def _film(x: jax.Array, index: jax.Array, course: Course) -> tuple[jax.Array, ...]:
    drone = unpack(x)
    lens = camera.make_lens(camera.FIELD_OF_VIEW_DEG, float(WIDTH_PX), float(HEIGHT_PX))
    axes = camera.camera_axes(drone.quat, camera.PITCH_DEG)
    corners, flags = [], []
    for gate in (course.gate(index), course.gate(course.next_index(index))):
        for corner in camera.opening_corners(axes, drone.pos_w, gate):
            pixel = camera.project(corner, lens)
            corners.append([pixel.right_px + 0.5 * WIDTH_PX, pixel.down_px + 0.5 * HEIGHT_PX])
            flags.append(pixel.is_visible)
    mask = camera.draw_frames(
        CameraPose(drone.pos_w, drone.quat),
        course.gates,
        camera.PITCH_DEG,
        camera.FIELD_OF_VIEW_DEG,
        (MASK_PX, MASK_PX),
    )
    coordinates = jnp.stack([jnp.stack(pair) for pair in corners])
    return coordinates.reshape(2, 4, 2), jnp.stack(flags).reshape(2, 4), mask[..., 0]
