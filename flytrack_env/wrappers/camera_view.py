"""What the wrappers that replace the observation by a camera's share."""

from collections.abc import Mapping
from typing import Any

from flytrack_env.effects import Range
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.observations import OBSERVATION
from flytrack_env.params import EnvParams
from flytrack_env.wrappers.base import Wrapper

# Starts in flight face the gate more nearly than FlyTrack's, 90 and 60 degrees: of those the camera
# shows no gate in a third, so that a policy has nothing to steer by.
MAX_START_YAW_DEG, MAX_START_TILT_DEG = 30.0, 30.0


class CameraView(Wrapper):
    """Replaces FlyTrack's observation by what its camera shows, and turns starts to the gate.

    Attributes:
        ranges: of its parameters.

    Raises:
        WrapperError: as ``Wrapper``, or an observation inside that is not FlyTrack's own.
    """

    ranges: Mapping[str, Range]

    @property
    def default_params(self) -> EnvParams:  # type: ignore[override]  # of gymnax: see EpisodicEnvironment
        """The inner environment's, with the camera, and with starts that face the gate."""
        params = super().default_params
        facing = params.reset._replace(
            course_yaw_deg=MAX_START_YAW_DEG, course_tilt_deg=MAX_START_TILT_DEG
        )
        return params.replace(reset=facing)

    def refusal(self, inside: EpisodicEnvironment) -> str | None:
        """Return why not: another observation inside, or what every wrapper refuses."""
        if inside.observation_table != OBSERVATION:
            return "it replaces FlyTrack's observation, and what was added to that would be lost"
        return super().refusal(inside)

    def check_params(self, params: EnvParams) -> None:
        """Raise ValueError, naming the field, for a camera beyond ``ranges``."""
        super().check_params(params)
        self.check_ranges(params, self.ranges)

    def with_own_params(self, params: EnvParams, own: Any) -> EnvParams:
        """Return the parameters with others of this wrapper."""
        return params.replace(wrappers={**params.wrappers, self.key: own})
