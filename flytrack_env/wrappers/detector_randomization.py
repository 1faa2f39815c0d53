"""Another camera and detector in every episode."""

from typing import NamedTuple

import jax

from flytrack_env.effects import Range
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.params import EnvParams
from flytrack_env.quaternion import Scalar
from flytrack_env.randomness import Draws
from flytrack_env.wrappers.base import WrapperError, layers_of
from flytrack_env.wrappers.episode_draws import DrawnState, EpisodeDraws
from flytrack_env.wrappers.gate_corners import CornersParams, GateCorners

RANGES = {
    "field_of_view_deg": Range(0.0, 90.0, "deg"),
    "pitch_deg": Range(0.0, 90.0, "deg"),
    "error_factor_low": Range(0.0, 1.0, "1"),
}


class DetectorRandomizationParams(NamedTuple):
    """Ranges of uniform draws, once per episode.

    Attributes:
        field_of_view_deg, pitch_deg: half ranges about the camera's own.
        error_factor_low: noise, misses, swaps and latency are each from this share of the
            detector's own up to all of it.
    """

    field_of_view_deg: Scalar = 5.0
    pitch_deg: Scalar = 3.0
    error_factor_low: Scalar = 0.0


class DetectorRandomization(EpisodeDraws):
    """Draw the camera's mounting and lens, and the detector's errors, anew in every episode.

    The ranges are ``params.wrappers["detector_randomization"]``, about the camera and the detector
    of ``GateCorners`` inside.

    Raises:
        WrapperError: as ``Wrapper``, or no ``GateCorners`` inside.
    """

    key = "detector_randomization"

    def __init__(self, env: EpisodicEnvironment):
        super().__init__(env)
        inside = [layer for layer in layers_of(env) if isinstance(layer, GateCorners)]
        if not inside:
            raise WrapperError("DetectorRandomization: found no GateCorners inside, expected one")
        self.corners = inside[0]

    def own_defaults(self) -> DetectorRandomizationParams:
        """Return the default ranges."""
        return DetectorRandomizationParams()

    def check_params(self, params: EnvParams) -> None:
        """Raise ValueError for ranges beyond ``RANGES``, or with a camera that shows nothing."""
        super().check_params(params)
        self.check_ranges(params, RANGES)
        ranges, detector = self.own_params(params), self.corners.own_params(params)
        for sign in (-1.0, 1.0):
            end = detector._replace(
                field_of_view_deg=detector.field_of_view_deg + sign * ranges.field_of_view_deg,
                pitch_deg=detector.pitch_deg + sign * ranges.pitch_deg,
            )
            self.corners.check_params(self.corners.with_own_params(params, end))

    def detector(self, state: DrawnState, params: EnvParams) -> CornersParams:
        """Return the camera and detector that a state's episode is flown with."""
        own: CornersParams = self.corners.own_params(self.drawn(state.word, params))
        return own

    def drawn(self, word: jax.Array, params: EnvParams) -> EnvParams:
        """Return parameters with the camera and detector of an episode."""
        ranges, detector = self.own_params(params), self.corners.own_params(params)
        draws, low = Draws(word), ranges.error_factor_low
        errors = {
            name: getattr(detector, name) * draws.uniform(name, low, 1.0)
            for name in ("noise_px", "missed", "swapped", "latency_s")
        }
        mounting = {
            name: getattr(detector, name)
            + draws.uniform(name, -getattr(ranges, name), getattr(ranges, name))
            for name in ("field_of_view_deg", "pitch_deg")
        }
        return self.corners.with_own_params(params, detector._replace(**errors, **mounting))
