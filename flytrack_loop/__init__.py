"""From a simulation's errors to a better policy: fly, diagnose, extend, retrain, fly again."""

from flytrack_loop.loop import Loop, Settings, close_loop
from flytrack_loop.stages import Errors, Gap, Stage, errors_of, fly_log, race, train_stage

__all__ = [
    "Errors",
    "Gap",
    "Loop",
    "Settings",
    "Stage",
    "close_loop",
    "errors_of",
    "fly_log",
    "race",
    "train_stage",
]
