"""Wrappers, each useful alone on any of the environments."""

from flytrack_env.wrappers.action_delay import ActionDelay
from flytrack_env.wrappers.action_history import ActionHistory
from flytrack_env.wrappers.base import Wrapper, WrapperError, layers_of
from flytrack_env.wrappers.detector_randomization import (
    DetectorRandomization,
    DetectorRandomizationParams,
)
from flytrack_env.wrappers.domain_randomization import DomainRandomization, RandomizationParams
from flytrack_env.wrappers.episode_statistics import EpisodeStatistics
from flytrack_env.wrappers.gate_corners import NOISY_DETECTOR, CornersParams, GateCorners
from flytrack_env.wrappers.gate_mask import GateMask, MaskParams
from flytrack_env.wrappers.legacy_step import DroneRaceEnv, LegacyStep
from flytrack_env.wrappers.observation_noise import NoiseParams, ObservationNoise
from flytrack_env.wrappers.state_observation import StateObservation

__all__ = [
    "NOISY_DETECTOR",
    "ActionDelay",
    "ActionHistory",
    "CornersParams",
    "DetectorRandomization",
    "DetectorRandomizationParams",
    "DomainRandomization",
    "DroneRaceEnv",
    "EpisodeStatistics",
    "GateCorners",
    "GateMask",
    "LegacyStep",
    "MaskParams",
    "NoiseParams",
    "ObservationNoise",
    "RandomizationParams",
    "StateObservation",
    "Wrapper",
    "WrapperError",
    "layers_of",
]
