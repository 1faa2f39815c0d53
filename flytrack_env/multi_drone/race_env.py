"""Several drones in one race: each flies an environment for one, and sees and meets the others.

All drones of all races are stepped side by side in one flat vector, those of a race next to each
other; what a drone needs of its opponents comes from shifts of the whole vector. Unrolled, the
drones would be compiled one by one, and stacked, they would have to be transposed in every step.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import spaces

from flytrack_env.auto_reset import Ended, reset_if_ended
from flytrack_env.episodes import (
    EpisodicEnvironment,
    Step,
    check_if_concrete,
    clip_action,
    observation_box,
)
from flytrack_env.fusion import compute_once, one_kernel, vary_like
from flytrack_env.multi_drone.collisions import Path, is_put_out
from flytrack_env.multi_drone.ghosts import Ghost
from flytrack_env.multi_drone.opponents import (
    Standing,
    gap_of,
    observe_opponents,
    opponent_table,
    progress_of,
    rank_of,
)
from flytrack_env.multi_drone.rules import (
    MAX_DRONES,
    RaceParams,
    RaceRules,
    check_apart,
    check_num_drones,
    check_rules,
)
from flytrack_env.multi_drone.start_grid import place_on_grid
from flytrack_env.observations import Entry
from flytrack_env.race import Race
from flytrack_env.randomness import Draws, check_key, seed_of, seeds_of
from flytrack_env.state import Action, Drone

CLEAR_OF_GHOSTS_M = 2.0
INDEX_BITS = MAX_DRONES - 1  # of a random word: which drone of the race it is


class EntrantState(NamedTuple):
    """One drone of a race.

    Attributes:
        inner: the state of its environment.
        leg_m: distance of its gate from the gate before.
        progress, is_out: as in ``Standing``.
        gap: as ``gap_of``.
        step: since the race began.
    """

    inner: Any
    leg_m: jax.Array
    progress: jax.Array
    is_out: jax.Array
    gap: jax.Array
    step: jax.Array


class SoloStep(NamedTuple):
    """The result of a drone's step without the others: state, standing, path, and outcome."""

    state: EntrantState
    standing: Standing
    path: Path
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    info: dict[str, jax.Array]


class MultiDroneRace:
    """A race of 1 to 8 drones, as pure functions; its drones are the first axis of everything.

    Each flies ``env``, with its own draws of whatever that environment draws. A drone that
    terminates or is put out by a collision is out: it stands still, is neither seen nor met any
    more, and gets a reward of 0. Observations are those of ``env``, and of the nearest opponents
    (``flytrack_env.multi_drone.opponents``).

    Args:
        env: the environment of one drone, wrapped or not.
        num_drones: 1 to 8. One drone flies exactly as in ``env``.
        over: when the race is over, and reset, before the time limit: once "all" drones are out, or
            "first", once drone 0 is.
        ghosts: by their place, from 1, drones that fly a given line
            (``flytrack_env.multi_drone.ghosts``). With any, races begin at the start pose, and the
            others on a grid that leaves the line free.

    Raises:
        ValueError: an image as observation, or another number of drones, value of ``over`` or place
            of a ghost.
        TypeError: an environment that is none of FlyTrack's.
    """

    def __init__(
        self,
        env: EpisodicEnvironment,
        num_drones: int = 2,
        over: Literal["all", "first"] = "all",
        ghosts: Mapping[int, Ghost] | None = None,
    ) -> None:
        if not isinstance(env, EpisodicEnvironment):
            raise TypeError(
                f"env: found {type(env).__name__}, expected FlyTrack or a wrapper around it"
            )
        if env.image_shape is not None:
            raise ValueError("env: found an image as observation, expected one made of rows")
        check_num_drones(num_drones)
        if over not in ("all", "first"):
            raise ValueError(f"over: found {over!r}, expected 'all' or 'first'")
        self.env, self.num_drones, self.over, self.ghosts = (
            env,
            num_drones,
            over,
            dict(ghosts or {}),
        )
        if not set(self.ghosts) <= set(range(1, num_drones)):
            raise ValueError(
                f"ghosts: found places {sorted(self.ghosts)}, "
                f"expected some of 1 to {num_drones - 1}"
            )

    def __repr__(self) -> str:
        return f"<MultiDroneRace of {self.num_drones}: {self.env!r}>"

    @property
    def default_params(self) -> RaceParams:
        """The environment's parameters, and the default rules."""
        params = RaceParams(self.env.default_params, RaceRules())
        if not self.ghosts:
            return params
        flight = params.flight.replace(reset=params.flight.reset._replace(course_fraction=0.0))
        return RaceParams(flight, params.rules._replace(column_spacing=CLEAR_OF_GHOSTS_M))

    @property
    def observation_table(self) -> tuple[Entry, ...]:
        """What an observation holds, row by row."""
        return (*self.env.observation_table, *opponent_table(self.num_drones))

    def observation_space(self, params: RaceParams | None = None) -> spaces.Box:
        """Return the box of one drone's observation."""
        return observation_box(self.observation_table)

    def action_space(self, params: RaceParams | None = None) -> spaces.Box:
        """Return the box of one drone's action."""
        return self.env.action_space()

    def drone(self, state: EntrantState) -> Drone:
        """Return the drone of one drone's state."""
        return self.env.drone(state.inner)

    def race(self, state: EntrantState) -> Race:
        """Return where the drone of one drone's state stands on the course."""
        return self.env.race(state.inner)

    def check_params(self, params: RaceParams) -> None:
        """Raise ValueError, naming the field, for concrete parameters that allow no race."""
        self.env.check_params(params.flight)
        check_rules(params.rules, self.num_drones)

    def reset(
        self, key: jax.Array, params: RaceParams | None = None
    ) -> tuple[jax.Array, EntrantState]:
        """Return observations, (num_drones, size) float32, and state of a race on the start grid.

        Raises:
            TypeError: a key that is none.
            ValueError: parameters that no race can be flown with, where their values are known.
        """
        check_key(key)
        params = self.default_params if params is None else params
        check_if_concrete(self, params)
        return self._reset(key, params)

    @partial(jax.jit, static_argnames=("self",))
    def _reset(self, key: jax.Array, params: RaceParams) -> tuple[jax.Array, EntrantState]:
        words = self._words(seed_of(key)[None])
        begun = jax.vmap(self._begin_from, (0, None))(words, params)
        rows, states = vary_like(begun, (key, params))
        return jnp.stack(rows, axis=-1), states

    def begin(
        self, drones: Drone, gate_indices: jax.Array, params: RaceParams, seed: Any = 0
    ) -> tuple[jax.Array, EntrantState]:
        """Return observations and state of a race that begins with given drones and gates.

        Leaves (num_drones,).

        Args:
            seed: uint32 word that decides whatever else the episode draws.

        Raises:
            ValueError: drones that start inside each other, where positions are known.
        """
        if not isinstance(drones.pos_w.x, jax.core.Tracer):
            check_apart(
                np.stack([np.asarray(coordinate, float) for coordinate in drones.pos_w], -1),
                params.rules,
            )
        words = self._words(jnp.asarray(seed, jnp.uint32)[None])
        states = jax.vmap(self._enter, (0, 0, None, 0))(drones, gate_indices, params, words)
        standings = self._standings(states)
        states = states._replace(gap=jax.vmap(gap_of)(standings, self._others(standings)))
        return self.observe(states, params), states

    def observe(self, states: EntrantState, params: RaceParams) -> jax.Array:
        """Return the observations of a race's state, (num_drones, size) float32."""
        others = self._others(self._standings(states))
        return jnp.stack(jax.vmap(self._observe, (0, 0, None))(states, others, params), axis=-1)

    @partial(jax.jit, static_argnames=("self",))
    def step(
        self,
        key: jax.Array,
        states: EntrantState,
        actions: jax.Array,
        params: RaceParams | None = None,
    ) -> Step:
        """Step the race with auto-reset.

        Args:
            actions: (num_drones, 4).

        Returns:
            Observations, states, rewards, whether each drone is out, whether the race is over for
            one that is not, and info: that of ``env`` while a drone flies, ``collision``,
            ``rank``, ``gap_gates``, ``race_over`` and ``final_observation``. Everything has
            num_drones in front.
        """
        return self._advance_flat(seed_of(key)[None], states, actions, params, resets=True)

    @partial(jax.jit, static_argnames=("self",))
    def step_env(
        self, states: EntrantState, actions: jax.Array, params: RaceParams | None = None
    ) -> Step:
        """Return the same without auto-reset."""
        return self._advance_flat(jnp.zeros(1, jnp.uint32), states, actions, params, resets=False)

    @partial(jax.jit, static_argnames=("self",))
    def step_batch(
        self,
        key: jax.Array,
        states: EntrantState,
        actions: jax.Array,
        params: RaceParams | None = None,
    ) -> Step:
        """``step`` for a batch of races with one key, faster than ``vmap(step)``.

        Args:
            states: leaves (num_races, num_drones).
            actions: (num_races, num_drones, 4).
        """
        shape = actions.shape[:-1]
        seeds = seeds_of(seed_of(key), jnp.arange(shape[0]))
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (states, actions))
        outcome = self._advance_flat(seeds, flat[0], flat[1], params, resets=True)
        return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), outcome)

    # Below, drones of all races are one flat vector.

    def _advance_flat(
        self,
        seeds: jax.Array,
        states: EntrantState,
        actions: jax.Array,
        params: RaceParams | None,
        resets: bool,
    ) -> Step:
        params = self.default_params if params is None else params
        dtype = jnp.result_type(self.env.drone(states.inner).pos_w.x)
        commands = jax.vmap(partial(clip_action, dtype=dtype))(actions)
        step = one_kernel(partial(self._transition, resets))
        rows, final_rows, states, reward, terminated, truncated, info = step(
            self._words(seeds), states, commands, params, self._ghosts_at(states.step)
        )
        info = {**info, "final_observation": jnp.stack(final_rows, axis=-1)}
        return jnp.stack(rows, axis=-1), states, reward, terminated, truncated, info

    def _transition(
        self,
        resets: bool,
        words: jax.Array,
        states: EntrantState,
        commands: Action,
        params: RaceParams,
        ghosts: tuple[jax.Array, Path, Standing] | None,
    ) -> tuple[Any, ...]:
        """Return observation rows, those before the reset, states, rewards, flags and info."""
        solo = jax.vmap(self._fly, (0, 0, None))(states, commands, params.flight)
        if ghosts is not None:
            solo = jax.vmap(_with_ghost)(solo, *ghosts)
        states, reward, info = solo.state, solo.reward, solo.info
        others: list[Standing] = []
        if self.num_drones > 1:
            meetings = self._others((solo.standing.is_out, solo.path))
            meet = jax.vmap(self._meet, (0, 0, None))
            states, collision, reward = meet(solo, meetings, params)
            standings = solo.standing._replace(is_out=states.is_out)
            others = self._others(standings)
            states, reward, standing_info = jax.vmap(self._rank, (0, 0, 0, 0, None))(
                states, standings, others, reward, params.rules
            )
            info = {**info, **standing_info, "collision": collision}
        terminated = states.is_out
        done = compute_once(self._is_over(terminated | solo.truncated))
        truncated = done & ~terminated  # for those that would have flown on
        final_rows = jax.vmap(self._observe, (0, 0, None))(states, others, params)
        rows = final_rows
        if resets:
            ended = Ended(done, (final_rows, states), words)
            rows, states = jax.vmap(partial(reset_if_ended, self._begin_from), (0, None))(
                ended, params
            )
        info = {**info, "terminated": terminated, "truncated": truncated, "race_over": done}
        return rows, final_rows, states, reward, terminated, truncated, info

    @property
    def _distances(self) -> range:
        return range(1, self.num_drones)

    # For one drone.

    def _begin_from(
        self, word: jax.Array, params: RaceParams
    ) -> tuple[list[jax.Array], EntrantState]:
        """Return observation rows and state of a drone on the start grid, from its random word."""
        if self.num_drones == 1:
            drone, gate_index = self.env.sample_start(word, params.flight)
            state = self._enter(drone, gate_index, params, word)
            return self._observe(state, [], params), state
        # Every drone of a race draws the same head of the grid, and so knows where the others are.
        race_word, index = word & ~jnp.uint32(INDEX_BITS), (word & INDEX_BITS).astype(jnp.int32)
        head, gate_index = self.env.sample_start(race_word, params.flight)
        drawn = Draws(race_word).index("slot", self.num_drones)
        first = jnp.where(jnp.asarray(params.rules.first_slot) < 0, drawn, params.rules.first_slot)
        slots = [(index + first + k) % self.num_drones for k in range(self.num_drones)]
        drone, *opponents = [
            place_on_grid(head, slot.astype(jnp.int32), params.rules) for slot in slots
        ]
        state = self._enter(drone, gate_index, params, word)
        gate = self.env.race(state.inner).gate
        own = self._standing(state)
        others = [
            own._replace(
                pos_w=opponent.pos_w,
                progress=progress_of(0, opponent.pos_w, gate.centre, state.leg_m),
            )
            for opponent in opponents
        ]
        for ghost_index, ghost in self.ghosts.items():
            standing = jax.tree.map(lambda leaf: leaf[0], ghost.standing(jnp.zeros(1, jnp.int32)))
            for k, other in enumerate(others, start=1):
                is_ghost = (index + k) % self.num_drones == ghost_index
                others[k - 1] = jax.tree.map(partial(jnp.where, is_ghost), standing, other)
        state = state._replace(gap=gap_of(own, others))
        return self._observe(state, others, params), state

    def _enter(
        self, drone: Drone, gate_index: Any, params: RaceParams, word: jax.Array
    ) -> EntrantState:
        """Return the state of a drone that enters a race."""
        inner = self.env.begin(drone, gate_index, params.flight, word)
        course, gate = params.flight.course, self.env.race(inner).gate
        index = jnp.asarray(gate_index)
        before = course.gate(jnp.where(index == 0, course.num_gates - 1, index - 1))
        leg_m = compute_once(jnp.asarray((gate.centre - before.centre).norm()))
        progress = progress_of(0, drone.pos_w, gate.centre, leg_m)
        return EntrantState(
            inner, leg_m, progress, jnp.asarray(False), jnp.float32(0.0), jnp.int32(0)
        )

    def _standing(self, state: EntrantState) -> Standing:
        drone = self.env.drone(state.inner)
        return Standing(drone.pos_w, drone.vel_w, state.progress, state.is_out)

    def _observe(
        self, state: EntrantState, others: list[Standing], params: RaceParams
    ) -> list[jax.Array]:
        """Return a drone's observation, row by row."""
        rows = self.env.observe_drone(self.env.drone(state.inner), state.inner, params.flight)
        if not others:
            return rows
        gate = self.env.race(state.inner).gate
        return [*rows, *observe_opponents(self._standing(state), others, gate)]

    def _fly(self, state: EntrantState, command: Action, flight: Any) -> SoloStep:
        """Return the result of a drone's step without the others; one that is out stays put."""
        env, was_out = self.env, state.is_out
        before, old_gate = env.drone(state.inner), env.race(state.inner).gate
        inner, reward, terminated, info = env.advance(state.inner, command, flight)
        if self.num_drones > 1:
            keep = partial(jnp.where, was_out)
            inner = jax.tree.map(keep, state.inner, inner)
            reward = jnp.where(was_out, 0.0, reward)
            info = {name: _where_flying(was_out, value) for name, value in info.items()}
        drone, race = env.drone(inner), env.race(inner)
        has_passed = race.gate_index != env.race(state.inner).gate_index
        new_leg_m = (race.gate.centre - old_gate.centre).norm()
        leg_m: jax.Array = compute_once(jnp.where(has_passed, new_leg_m, state.leg_m))
        progress = progress_of(race.gates_passed, drone.pos_w, race.gate.centre, leg_m)
        state = EntrantState(
            inner, leg_m, progress, was_out | terminated, state.gap, state.step + 1
        )
        return SoloStep(
            state=state,
            standing=Standing(drone.pos_w, drone.vel_w, progress, was_out),
            path=Path(before.pos_w, drone.pos_w),
            reward=reward,
            terminated=terminated,
            truncated=env.is_truncated(inner, flight),
            info=info,
        )

    def _meet(
        self, solo: SoloStep, opponents: list[tuple[jax.Array, Path]], params: RaceParams
    ) -> tuple[EntrantState, jax.Array, jax.Array]:
        """Return a drone's state after a step, whether a collision put it out, and its reward.

        A ghost is put out for that step only: ``_with_ghost`` lets it fly on.
        """
        hit = jnp.asarray(False)
        for is_out, path in opponents:
            hit = hit | (is_put_out(solo.path, path, params.rules) & ~is_out)
        hit = compute_once(hit & ~solo.standing.is_out)
        is_new = hit & ~solo.terminated
        reward = solo.reward + jnp.where(is_new, params.flight.reward.termination, 0.0)
        return solo.state._replace(is_out=solo.state.is_out | hit), hit, reward

    def _rank(
        self,
        state: EntrantState,
        own: Standing,
        others: list[Standing],
        reward: jax.Array,
        rules: RaceRules,
    ) -> tuple[EntrantState, jax.Array, dict[str, jax.Array]]:
        """Return a drone's state with its gap, its reward with the gap's gain, and info."""
        gap = compute_once(gap_of(own, others))
        gain = jnp.where(own.is_out, 0.0, gap - state.gap)
        standing_info = {"rank": rank_of(own, others), "gap_gates": gap}
        return state._replace(gap=gap), reward + rules.lead * gain, standing_info

    # Of the flat vector.

    def _standings(self, states: EntrantState) -> Standing:
        """Return all standings, those of ghosts on their lines."""
        standings = jax.vmap(self._standing)(states)
        index = jnp.arange(len(states.step)) % self.num_drones
        for ghost_index, ghost in self.ghosts.items():
            choose = partial(jnp.where, index == ghost_index)
            standings = jax.tree.map(choose, ghost.standing(states.step), standings)
        return standings

    def _ghosts_at(self, steps: jax.Array) -> tuple[jax.Array, Path, Standing] | None:
        """Return which drones are ghosts, their next paths and standings; None without ghosts."""
        ghosts: Any = None
        index = jnp.arange(len(steps)) % self.num_drones
        for ghost_index, ghost in self.ghosts.items():
            before, after = ghost.standing(steps), ghost.standing(steps + 1)
            is_ghost = index == ghost_index
            line = (is_ghost, Path(before.pos_w, after.pos_w), after)
            ghosts = (
                line if ghosts is None else jax.tree.map(partial(jnp.where, is_ghost), line, ghosts)
            )
        return ghosts

    def _words(self, seeds: jax.Array) -> jax.Array:
        """Return a random word for each drone of each race, from one for each race."""
        if self.num_drones == 1:
            return seeds
        indices = jnp.arange(self.num_drones, dtype=jnp.uint32)
        return ((seeds & ~jnp.uint32(INDEX_BITS))[:, None] | indices).reshape(-1)

    def _others(self, tree: Any) -> list[Any]:
        """For each drone, take the leaves of each other drone of its race, in their order."""
        return [self._shift(tree, distance) for distance in self._distances]

    def _shift(self, tree: Any, distance: int) -> Any:
        """For each drone, take the leaves of the drone ``distance`` places later, cyclically."""
        size = len(jax.tree.leaves(tree)[0])
        index = jnp.arange(size) % self.num_drones
        is_later = compute_once(index + distance < self.num_drones)

        def shift(leaf: jax.Array) -> jax.Array:
            back = self.num_drones - distance
            later = jnp.concatenate([leaf[distance:], leaf[:distance]])
            earlier = jnp.concatenate([leaf[size - back :], leaf[: size - back]])
            return jnp.where(is_later, later, earlier)

        return jax.tree.map(shift, tree)

    def _is_over(self, done: jax.Array) -> jax.Array:
        """Return whether the race of each drone is over."""
        if self.over == "all":
            over = done
            for k in self._distances:
                over = over & self._shift(done, k)
            return over
        index, over = jnp.arange(len(done)) % self.num_drones, done
        for k in self._distances:
            over = jnp.where(index == self.num_drones - k, self._shift(done, k), over)
        return over


def _with_ghost(solo: SoloStep, is_ghost: jax.Array, path: Path, standing: Standing) -> SoloStep:
    """Return a drone's step as it is, or as that of a ghost, which is never out."""

    def choose(ghost: Any, own: Any) -> Any:
        return jax.tree.map(partial(jnp.where, is_ghost), ghost, own)

    state = solo.state
    return solo._replace(
        state=state._replace(
            progress=choose(standing.progress, state.progress), is_out=state.is_out & ~is_ghost
        ),
        standing=choose(standing, solo.standing),
        path=choose(path, solo.path),
        terminated=solo.terminated & ~is_ghost,
    )


def _where_flying(was_out: jax.Array, value: jax.Array) -> jax.Array:
    """Return a value of info, 0 or False for a drone that is out."""
    return jnp.where(was_out, jnp.zeros_like(value), value)
