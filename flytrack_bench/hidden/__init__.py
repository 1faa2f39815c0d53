"""Hidden drones: the truth that models and policies are judged on.

Their equations share no code with the simulator of ``flytrack_env``. ``HiddenDrone`` flies in plain
floats and has every effect, law and motion; ``HiddenPlant`` flies the same equations in an
environment, but those that remember or change with the time.
"""

from flytrack_bench.hidden.drone import HiddenDrone, Start
from flytrack_bench.hidden.plant import HiddenPlant, HiddenState
from flytrack_bench.hidden.truth import DT_S, GRAVITY, MOTIONS, STICKS, Gust, Outside, Truth

__all__ = [
    "DT_S",
    "GRAVITY",
    "MOTIONS",
    "STICKS",
    "Gust",
    "HiddenDrone",
    "HiddenPlant",
    "HiddenState",
    "Outside",
    "Start",
    "Truth",
]
