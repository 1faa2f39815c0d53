"""FlyTrack: a drone-racing environment in JAX. Importing it registers its ids with gymnax."""

from flytrack_env.battery import Battery, BatteryWarning
from flytrack_env.compile_cache import keep_compiled_programs
from flytrack_env.dynamics import ModelParameters, nominal_parameters
from flytrack_env.extras import import_gymnax

import_gymnax()  # before what needs it

from flytrack_env.env import EnvParams, EnvState, FlyTrack
from flytrack_env.gymnasium_adapter import register_with_gymnasium
from flytrack_env.model_file import ModelFileError, load_model, load_provenance, save_model
from flytrack_env.motion import Motion
from flytrack_env.registration import make, make_race, make_versus, register_all
from flytrack_env.tracks import (
    Track,
    TrackError,
    available_tracks,
    find_problems,
    load_track,
    random_track,
    save_track,
)
from flytrack_env.wrappers import DroneRaceEnv

keep_compiled_programs()
register_all()
register_with_gymnasium()

__version__ = "0.1.0"

__all__ = [
    "Battery",
    "BatteryWarning",
    "DroneRaceEnv",
    "EnvParams",
    "EnvState",
    "FlyTrack",
    "ModelFileError",
    "ModelParameters",
    "Motion",
    "Track",
    "TrackError",
    "available_tracks",
    "find_problems",
    "load_model",
    "load_provenance",
    "load_track",
    "make",
    "make_race",
    "make_versus",
    "nominal_parameters",
    "random_track",
    "register_all",
    "save_model",
    "save_track",
]
