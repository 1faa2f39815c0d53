"""Wrappers, each useful alone on any of the environments."""

from flytrack_env.wrappers.action_delay import ActionDelay
from flytrack_env.wrappers.action_history import ActionHistory
from flytrack_env.wrappers.base import Wrapper, WrapperError, layers_of
from flytrack_env.wrappers.domain_randomization import DomainRandomization, RandomizationParams
from flytrack_env.wrappers.episode_statistics import EpisodeStatistics
from flytrack_env.wrappers.legacy_step import DroneRaceEnv, LegacyStep
from flytrack_env.wrappers.observation_noise import NoiseParams, ObservationNoise

__all__ = [
    "ActionDelay",
    "ActionHistory",
    "DomainRandomization",
    "DroneRaceEnv",
    "EpisodeStatistics",
    "LegacyStep",
    "NoiseParams",
    "ObservationNoise",
    "RandomizationParams",
    "Wrapper",
    "WrapperError",
    "layers_of",
]
