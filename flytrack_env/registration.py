"""The tables of environments and races by id, and their registration with gymnax."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import gymnax
from gymnax.registration import registered_envs

from flytrack_env.dynamics import nominal_motor_parameters
from flytrack_env.effects import check_motors, takes_motors
from flytrack_env.env import FlyTrack
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.messages import check_keywords
from flytrack_env.multi_drone import MultiDroneRace, Opponent, Versus, idle
from flytrack_env.multi_drone.ghosts import Ghost, time_optimal_ghost
from flytrack_env.multi_drone.rules import MAX_DRONES
from flytrack_env.wrappers import (
    NOISY_DETECTOR,
    ActionHistory,
    DetectorRandomization,
    DomainRandomization,
    GateCorners,
    GateMask,
    ObservationNoise,
)


class Variant(NamedTuple):
    """One id: what it is, the base arguments of ``FlyTrack``, and the wrappers, innermost first."""

    summary: str
    arguments: Mapping[str, Any] = {}
    wrappers: tuple[Callable[[EpisodicEnvironment], EpisodicEnvironment], ...] = ()


ARGUMENTS = tuple(inspect.signature(FlyTrack).parameters)  # of make, by name
GHOST_DELAY_S = 0.3
HISTORY = partial(ActionHistory, length=3)
LAST_ACTION = partial(ActionHistory, length=1)
NOISY_CORNERS = partial(GateCorners, detector=NOISY_DETECTOR)

ENVIRONMENTS: dict[str, Variant] = {
    "FlyTrack-v0": Variant("The race with perfect sensors and one known drone."),
    "FlyTrackNoisy-v0": Variant(
        "The race seen through noisy sensors.", wrappers=(ObservationNoise,)
    ),
    "FlyTrackActionHistory-v0": Variant(
        "The race with the last three commands in the observation.", wrappers=(HISTORY,)
    ),
    "FlyTrackRandomized-v0": Variant(
        "The race with another drone, and other air, in every episode.",
        wrappers=(DomainRandomization,),
    ),
    "FlyTrackRobust-v0": Variant(
        "All of it: another drone in every episode, noisy sensors, the last three commands.",
        wrappers=(DomainRandomization, ObservationNoise, HISTORY),
    ),
    "FlyTrackCorners-v0": Variant(
        "The race seen by a perfect gate detector: corners in a camera's image, gyro, "
        "accelerometer, battery and the last command.",
        wrappers=(GateCorners, LAST_ACTION),
    ),
    "FlyTrackCornersNoisy-v0": Variant(
        "The race seen by a gate detector that is late, noisy and misses corners.",
        wrappers=(NOISY_CORNERS, ObservationNoise, LAST_ACTION),
    ),
    "FlyTrackCornersRobust-v0": Variant(
        "The same with another drone and another camera in every episode, and the last three "
        "commands.",
        wrappers=(
            DomainRandomization,
            NOISY_CORNERS,
            DetectorRandomization,
            ObservationNoise,
            HISTORY,
        ),
    ),
    "FlyTrackMask-v0": Variant(
        "The race seen as a binary image of the gates' frames.", wrappers=(GateMask,)
    ),
    "FlyTrackMotors-v0": Variant(
        "The race with the outputs of four motors as commands; motors and rates at 600 Hz.",
        arguments={"model": nominal_motor_parameters()},
    ),
}


def make(env_id: str, **overrides: Any) -> EpisodicEnvironment:
    """Return the environment of an id; ``overrides`` are arguments of ``FlyTrack``.

    An argument of None is the id's own. With a plant that has its parameters baked in (a black
    box), ids that randomise the model fly that plant as it is, with the same observation: what was
    trained on the id can be flown on the plant.

    Raises:
        ValueError: unknown id, a model without motors in an id whose commands are those, or a model
            with motors and without their frame.
        TypeError: unknown argument.
    """
    if env_id not in ENVIRONMENTS:
        raise ValueError(f"env_id: found {env_id!r}, expected one of {', '.join(ENVIRONMENTS)}")
    check_keywords(overrides, ARGUMENTS)
    variant = ENVIRONMENTS[env_id]
    given = {name: value for name, value in overrides.items() if value is not None}
    env: EpisodicEnvironment = FlyTrack(**{**variant.arguments, **given})
    check_motors(env.default_params.model.effects)
    is_of_motors = takes_motors(env.default_params.model.effects)
    if "model" in variant.arguments and env.plant.dt is None and not is_of_motors:
        raise ValueError(
            f"model: found one that sticks command, expected one with the effect motors in {env_id}"
        )
    for wrapper in variant.wrappers:
        if wrapper is DomainRandomization and env.plant.dt is not None:
            continue
        env = wrapper(env)
    env.env_id = env_id
    return env


RACES = {
    "FlyTrackDuel-v0": range(2, 3),
    "FlyTrackRace-v0": range(2, MAX_DRONES + 1),
}  # numbers of drones


def make_race(
    race_id: str,
    num_drones: int = 2,
    over: Literal["all", "first"] = "all",
    env_id: str = "FlyTrack-v0",
    ghosts: Mapping[int, Ghost] | None = None,
    **overrides: Any,
) -> MultiDroneRace:
    """Return the race of an id: ``FlyTrackDuel-v0``, or ``FlyTrackRace-v0`` of 2 to 8 drones.

    Args:
        over: as in ``flytrack_env.multi_drone.MultiDroneRace``.
        ghosts: the same.
        env_id: of the environment that each drone flies.
        overrides: further arguments of ``make`` for it.

    Raises:
        ValueError: unknown id, or a number of drones that it does not have.
        TypeError: unknown argument.
    """
    if race_id not in RACES:
        raise ValueError(f"race_id: found {race_id!r}, expected one of {', '.join(RACES)}")
    numbers = RACES[race_id]
    if num_drones not in numbers:
        raise ValueError(
            f"num_drones: found {num_drones!r}, expected {numbers[0]} to {numbers[-1]}"
        )
    return MultiDroneRace(make(env_id, **overrides), num_drones, over, ghosts)


def make_versus(
    race_id: str, opponents: Sequence[Opponent] | None = None, num_drones: int = 2, **arguments: Any
) -> Versus:
    """Return gymnax's view of a race for one learner, drone 0.

    Args:
        opponents: of the others; by default time-optimal ghosts, each ``GHOST_DELAY_S`` after the
            one before.
        arguments: of ``make_race``.

    Raises:
        ValueError: as ``make_race`` and ``Versus``, and without opponents on a track without a
            time-optimal lap.
    """
    race = make_race(race_id, num_drones, "first", **arguments)
    if opponents is None:
        delays_s = {index: GHOST_DELAY_S * (index - 1) for index in range(1, num_drones)}
        ghosts = {
            index: time_optimal_ghost(race.env.track, delay_s)
            for index, delay_s in delays_s.items()
        }
        race = MultiDroneRace(race.env, num_drones, "first", ghosts)
        opponents = [idle(race)] * len(ghosts)
    return Versus(race, opponents)


def register_all() -> None:
    """Register every id with gymnax; ids that are registered already are left alone."""
    for table, maker in ((ENVIRONMENTS, make), (RACES, make_versus)):
        for env_id in table:
            if env_id not in registered_envs:
                gymnax.register(env_id, partial(maker, env_id))
