"""Races of several drones: the race, and its views for other libraries."""

from flytrack_env.multi_drone.race_env import EntrantState, MultiDroneRace
from flytrack_env.multi_drone.rules import RaceParams, RaceRules
from flytrack_env.multi_drone.versus import Opponent, Versus, VersusParams, idle

__all__ = [
    "EntrantState",
    "MultiDroneRace",
    "Opponent",
    "RaceParams",
    "RaceRules",
    "Versus",
    "VersusParams",
    "idle",
]
