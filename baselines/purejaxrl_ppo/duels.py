"""Races of several policies against each other, and who wins."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from baselines.purejaxrl_ppo.networks import Policy
from flytrack_env.multi_drone import MultiDroneRace, RaceParams
from flytrack_env.rollout import save_rollout
from flytrack_env.state import pack

MOST_STEPS = 1500  # of a race of three laps


class Races(NamedTuple):
    """Races flown to their end; leaves (num_races, num_steps, num_drones, ...).

    states, actions: packed (21,), (4,), before the step. is_out, collision, lap_completed, lap_time_s, rank:
    as told by the race (``flytrack_env.multi_drone``), after it.
    """

    states: np.ndarray
    actions: np.ndarray
    is_out: np.ndarray
    collision: np.ndarray
    lap_completed: np.ndarray
    lap_time_s: np.ndarray
    rank: np.ndarray

    def finish_s(self, num_laps: int) -> np.ndarray:
        """Return when each drone had flown its laps, s, (num_races, num_drones); inf if never."""
        lap_s = np.where(self.lap_completed, self.lap_time_s, 0.0)
        has_finished = self.lap_completed.cumsum(axis=1) >= num_laps
        first = has_finished.argmax(axis=1)[:, None]
        finish_s = np.take_along_axis(lap_s.cumsum(axis=1), first, axis=1)[:, 0]
        return np.where(has_finished.any(axis=1), finish_s, np.inf)

    def save(self, race: int, folder: Path, names: Sequence[str] = ()) -> list[Path]:
        """Write one race as a rollout of each drone, up to where it is out; return the files.

        names: of the files, by default drone_0 and so on. ``flytrack show`` draws and records them side by
        side.
        """
        paths = []
        for place in range(self.states.shape[2]):
            steps = slice(int((~self.is_out[race, :, place]).sum()) + 1)
            paths.append(folder / f"{names[place] if names else f'drone_{place}'}.npy")
            save_rollout(paths[-1], self.states[race, steps, place], self.actions[race, steps, place])
        return paths


class Score(NamedTuple):
    """Shares of races: that drone 0 finishes, that it wins, and that a collision puts anyone out.

    Only what happens before the winner has finished is a collision of the race.
    """

    finishes: float
    wins: float
    collisions: float


@partial(jax.jit, static_argnames=("race", "num_steps"))
def _fly(
    race: MultiDroneRace, policies: tuple[Policy, ...], keys: jax.Array, params: RaceParams, num_steps: int
) -> tuple[jax.Array, ...]:
    def step(carry: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], tuple[jax.Array, ...]]:
        observations, states = carry
        actions = jnp.stack(
            [
                policy.network.act(policy.params, (), observations[:, place, : input_size(policy)])[1]
                for place, policy in enumerate(policies)
            ],
            axis=1,
        )
        packed = jax.vmap(jax.vmap(lambda state: pack(race.drone(state))))(states)
        after = jax.vmap(race.step_env, (0, 0, None))(states, actions, params)
        observations, states, info = after[0], after[1], after[-1]
        told = (info[name] for name in ("collision", "lap_completed", "lap_time_s", "rank"))
        return (observations, states), (packed, actions, states.is_out, *told)

    start = jax.vmap(race.reset, (0, None))(keys, params)
    return jax.lax.scan(step, start, None, num_steps)[1]


def input_size(policy: Policy) -> int:
    """Return how many rows of an observation a policy reads."""
    return int(policy.params["params"]["actor_tower"]["layers_0"]["kernel"].shape[0])


def start_pose_params(params: RaceParams, first_slot: int, num_steps: int = MOST_STEPS) -> RaceParams:
    """Return parameters of races from the noisy start pose, drone 0 in a slot of the grid."""
    reset = params.flight.reset._replace(course_fraction=0.0)
    flight = params.flight.replace(reset=reset, max_steps_in_episode=num_steps)
    return RaceParams(flight, params.rules._replace(first_slot=first_slot))


def fly_races(
    race: MultiDroneRace,
    policies: tuple[Policy, ...],
    params: RaceParams,
    seed: int,
    num_races: int,
    num_steps: int = MOST_STEPS,
) -> Races:
    """Return races of a policy for each drone, each flying its mean action; policies have no memory.

    A policy that reads fewer rows than the race's observation gets the first of them.
    """
    keys = jax.random.split(jax.random.key(seed), num_races)
    flown = _fly(race, policies, keys, params, num_steps)
    return Races(*(np.swapaxes(np.asarray(leaf), 0, 1) for leaf in flown))


def score(races: Races, num_laps: int) -> Score:
    """Return how drone 0 did."""
    finish_s = races.finish_s(num_laps)
    over_s = finish_s.min(axis=1)
    times_s = 0.01 * np.arange(1, races.collision.shape[1] + 1)
    is_racing = times_s[None, :] <= over_s[:, None]
    return Score(
        finishes=float(np.isfinite(finish_s[:, 0]).mean()),
        wins=float((finish_s[:, 0] < finish_s[:, 1:].min(axis=1)).mean()),
        collisions=float((races.collision.any(axis=2) & is_racing).any(axis=1).mean()),
    )
