"""Races of several drones: the race, and its views for other libraries."""

from flytrack_env.multi_drone.collisions import Path, is_put_out
from flytrack_env.multi_drone.race_env import EntrantState, MultiDroneRace
from flytrack_env.multi_drone.rules import RaceParams, RaceRules
from flytrack_env.multi_drone.start_grid import place_on_grid
from flytrack_env.multi_drone.versus import Opponent, Versus, VersusParams, idle

__all__ = [
    "EntrantState",
    "MultiDroneRace",
    "Opponent",
    "Path",
    "RaceParams",
    "RaceRules",
    "Versus",
    "VersusParams",
    "idle",
    "is_put_out",
    "place_on_grid",
]
