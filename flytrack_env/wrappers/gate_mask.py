"""The camera's image as a mask of the gates' frames."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from flytrack_env import camera
from flytrack_env.camera import CameraPose
from flytrack_env.effects import Range
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.observations import Entry
from flytrack_env.params import EnvParams
from flytrack_env.quaternion import Quaternion, Scalar, Vec3
from flytrack_env.state import Drone
from flytrack_env.wrappers.camera_view import CameraView


class MaskParams(NamedTuple):
    """The camera: horizontal field of view, and pitch of the optical axis above body x, degrees."""

    field_of_view_deg: Scalar = camera.FIELD_OF_VIEW_DEG
    pitch_deg: Scalar = camera.PITCH_DEG


class GateMask(CameraView):
    """Observe a binary image of the frames of all gates, (height, width, 1) uint8: 255 on a frame.

    The camera is ``params.wrappers["gate_mask"]``, a ``MaskParams``. In a binary image a nearer
    frame hides nothing of a farther one. Drawn once per observation, outside of the step's kernel,
    of the camera's pose: no gradient passes.

    Args:
        size: height and width, px.

    Raises:
        ValueError: fewer than 8 px, or more than a million.
        WrapperError: as ``CameraView``.
    """

    key = "gate_mask"
    ranges: Mapping[str, Range] = camera.RANGES

    def __init__(self, env: EpisodicEnvironment, size: tuple[int, int] = (64, 64)):
        super().__init__(env)
        height, width = size
        camera.check_pixels(width, height, "size: ")
        self.size = size
        self.image_shape = (*size, 1)

    @property
    def observation_table(self) -> tuple[Entry, ...]:
        """The image as one entry."""
        height, width = self.size
        name = f"mask of the gates' frames, row by row, 0 or {camera.WHITE}"
        return (Entry("mask", name, height * width, "image", "1", 1.0, float(camera.WHITE)),)

    def own_defaults(self) -> MaskParams:
        """Return the default camera."""
        return MaskParams()

    def observe_drone(self, drone: Drone, state: Any, params: EnvParams) -> list[jax.Array]:
        """Return the true pose of the camera as scalars, of which ``compose`` draws the image."""
        true = self.drone(state)
        return [jnp.asarray(part) for part in (*true.pos_w, *true.quat)]

    def compose(self, rows: list[jax.Array], params: EnvParams) -> jax.Array:
        """Return the image that the camera shows at a pose."""
        own = self.own_params(params)
        pose = CameraPose(Vec3(*rows[:3]), Quaternion(*rows[3:]))
        return camera.draw_frames(
            pose, params.course.gates, own.pitch_deg, own.field_of_view_deg, self.size
        )
