"""Episodes: gymnax's ``reset`` and ``step`` from an environment's hooks, auto-reset outermost.

An environment, or a wrapper around one, implements the hooks of ``EpisodicEnvironment``: how an
episode begins, advances and is observed. ``reset``, ``step`` and ``step_batch`` are built from them
here, once, and called on the outermost object only, so that the state of a wrapper is fresh in
every episode.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import environment, spaces

from flytrack_env.auto_reset import Ended, reset_if_ended
from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import effect_of
from flytrack_env.fusion import compute_once, one_kernel, vary_like
from flytrack_env.observations import Entry
from flytrack_env.params import EnvParams
from flytrack_env.plants import Plant
from flytrack_env.race import Race
from flytrack_env.randomness import check_key, seed_of, seeds_of
from flytrack_env.state import ACTION_SIZE, Action, Drone, unpack_action
from flytrack_env.tracks import Track

Step = tuple[jax.Array, Any, jax.Array, jax.Array, jax.Array, dict[str, Any]]


def observation_box(table: tuple[Entry, ...]) -> spaces.Box:
    """Return an observation's table as a box."""
    limits = [np.full(entry.size, entry.limit, np.float32) for entry in table]
    limit = jnp.asarray(np.concatenate(limits))
    return spaces.Box(-limit, limit, limit.shape, jnp.float32)


def clip_action(action: jax.Array, dtype: Any = None) -> Action:
    """Return the command of an action (4,), clipped to [-1, 1]; infinite values clip, NaN stays.

    Args:
        dtype: of the command; the action's own if None.
    """
    command = unpack_action(jnp.asarray(action, dtype))
    # The fence: a batch of actions is strided, and what reads strided memory is not vectorised.
    return compute_once(Action(*(jnp.clip(value, -1.0, 1.0) for value in command)))


def without_nan(command: Action) -> Action:
    """Return the command with NaN replaced by 0, so that it cannot poison a state."""
    return Action(*(jnp.where(jnp.isnan(value), 0.0, value) for value in command))


def _keep_types(changed: Any, state: Any) -> Any:
    """Return a changed state with the types of the state before, whatever the parameters' types."""
    return jax.tree.map(lambda leaf, old: jnp.asarray(leaf, jnp.result_type(old)), changed, state)


def check_if_concrete(env: Any, params: Any) -> None:
    """Check parameters where their values are known, which they are not while they are traced."""
    if not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(params)):
        # As NumPy: comparing JAX's arrays would be traced where the reset is.
        env.check_params(jax.tree.map(np.asarray, params))


# Our EnvParams are not of gymnax's class, which its annotations ask for and its code does not.
class EpisodicEnvironment(environment.Environment[Any, EnvParams]):  # type: ignore[type-var]
    """An environment for gymnax, made of hooks for one drone; a state is any pytree.

    Attributes:
        track: the course.
        plant: what moves the drone.
        missed_gate: "terminate" or "fly_on".
        env_id: as registered.
        image_shape: height, width and channels of an observation that is an image of uint8; None
            where it is a vector of float32.
    """

    _supports_transition_gradients = True
    track: Track
    plant: Plant
    missed_gate: str
    env_id = "FlyTrack-v0"
    image_shape: tuple[int, int, int] | None = None

    # The hooks.

    @property
    def default_params(self) -> EnvParams:  # type: ignore[override]
        """Parameters that the environment was made with."""
        raise NotImplementedError

    @property
    def observation_table(self) -> tuple[Entry, ...]:
        """What an observation holds, row by row."""
        raise NotImplementedError

    def drone(self, state: Any) -> Drone:
        """Return the drone of a state, as it is."""
        raise NotImplementedError

    def race(self, state: Any) -> Race:
        """Return where the drone stands in the race."""
        raise NotImplementedError

    def model(self, state: Any, params: EnvParams) -> ModelParameters:
        """Return the model that a state's episode is flown with."""
        raise NotImplementedError

    def sample_start(self, seed: jax.Array, params: EnvParams) -> tuple[Drone, jax.Array]:
        """Return an episode's first drone and first gate (an index), drawn from a uint32 scalar."""
        raise NotImplementedError

    def begin(self, drone: Drone, gate_index: Any, params: EnvParams, seed: Any = 0) -> Any:
        """Return the state of an episode that begins with a given drone and gate to fly first.

        Args:
            seed: uint32 word that decides whatever else an episode draws (noise, a model).
        """
        raise NotImplementedError

    def advance(
        self, state: Any, command: Action, params: EnvParams
    ) -> tuple[Any, jax.Array, jax.Array, dict[str, Any]]:
        """Return next state, reward, whether the episode terminates, and info; no auto-reset.

        Reward and terminated are scalars.

        Args:
            command: within [-1, 1]; one that is not a number ends the episode and may not get into
                the state.
        """
        raise NotImplementedError

    def observe_drone(self, drone: Drone, state: Any, params: EnvParams) -> list[jax.Array]:
        """Return the observation where sensors report ``drone``: a float32 scalar per row."""
        raise NotImplementedError

    def compose(self, rows: list[jax.Array], params: EnvParams) -> jax.Array:
        """Return the observation that the rows of ``observe_drone`` are made into: the stack.

        Called outside of the step's kernel.
        """
        return jnp.stack(rows)

    def is_truncated(self, state: Any, params: EnvParams) -> jax.Array:
        """Return whether the episode is cut off, by the time limit, a bool scalar."""
        raise NotImplementedError

    def check_params(self, params: EnvParams) -> None:
        """Raise ValueError, naming the field, for concrete values that cannot be flown."""
        raise NotImplementedError

    # What follows from them.

    @property
    def name(self) -> str:
        """The registered id."""
        return self.env_id

    def __repr__(self) -> str:
        effects = (
            ", ".join(
                effect_of(parameters).name for parameters in self.default_params.model.effects
            )
            or "none"
        )
        track, plant, size = (
            self.track.name,
            type(self.plant).__name__,
            " x ".join(map(str, self.observation_space().shape)),
        )
        return (
            f"<{self.env_id}: track {track}, plant {plant}, effects {effects}, "
            f"observation size {size}>"
        )

    @property
    def num_actions(self) -> int:
        """Number of components of an action."""
        return ACTION_SIZE

    def action_space(self, params: EnvParams | None = None) -> spaces.Box:
        """Roll-rate, pitch-rate, yaw-rate and thrust command, each in [-1, 1]."""
        return spaces.Box(-1.0, 1.0, (ACTION_SIZE,), jnp.float32)

    def observation_space(self, params: EnvParams | None = None) -> spaces.Box:
        """The observation's table as a box; of an image, its shape in uint8."""
        if self.image_shape is not None:
            return spaces.Box(0, 255, self.image_shape, jnp.uint8)
        return observation_box(self.observation_table)

    def observe(
        self, key: jax.Array | None, state: Any, action: Any, params: EnvParams
    ) -> jax.Array:
        """Return the observation of a state, (size,) float32; key and action are unused."""
        del key, action
        return self.compose(self._rows(state, params), params)

    def step_env(  # type: ignore[override]  # actions are arrays here
        self, key: jax.Array | None, state: Any, action: jax.Array, params: EnvParams
    ) -> tuple[jax.Array, Any, jax.Array, jax.Array, dict[str, Any]]:
        """Return observation, state, reward, terminated and info of one step, without auto-reset.

        The observation is (size,), of the type of the state, as the reward is; reward and
        terminated are scalars.

        Args:
            key: unused.
            action: (4,).
        """
        del key
        rows, next_state, reward, flags, info = one_kernel(self._transition)(
            state, clip_action(action, self._dtype(state)), params
        )
        return self.compose(rows, params), next_state, reward, flags["terminated"], info

    def reset(  # type: ignore[override]  # gymnax's is compiled; this one checks, then calls it
        self, key: jax.Array, params: EnvParams | None = None
    ) -> tuple[jax.Array, Any]:
        """Return observation, (size,) float32, and state of an episode that begins.

        Raises:
            TypeError: a key that is none, or more than one.
            ValueError: parameters of another environment's wrappers; or that no episode can be
                flown with, where their values are known (not while they are traced).
        """
        check_key(key)
        if params is None:
            params = self.default_params
        expected = sorted(self.default_params.wrappers)
        if sorted(params.wrappers) != expected:
            found = sorted(params.wrappers)
            raise ValueError(
                f"params.wrappers: found {found}, expected {expected}, as in default_params"
            )
        check_if_concrete(self, params)
        return super().reset(key, params)

    def reset_env(self, key: jax.Array, params: EnvParams) -> tuple[jax.Array, Any]:
        """Return observation, (size,) float32, and state of a new episode; nothing is checked."""
        rows, state = vary_like(self._begin_from(seed_of(key), params), (key, params))
        return self.compose(rows, params), state

    def _begin_from(self, seed: jax.Array, params: EnvParams) -> tuple[list[jax.Array], Any]:
        """Return observation, row by row, and state of a new episode, from one random word."""
        state = self.begin(*self.sample_start(seed, params), params, seed)
        return self._rows(state, params), state

    def _dtype(self, state: Any) -> Any:
        """Return the floating-point type of a state, which its observation and reward have, too."""
        return jnp.result_type(self.drone(state).pos_w.x)

    def _rows(self, state: Any, params: EnvParams) -> list[jax.Array]:
        """Return the observation of a state, row by row."""
        dtype = self._dtype(state)
        return [
            jnp.asarray(row, dtype) for row in self.observe_drone(self.drone(state), state, params)
        ]

    @partial(jax.jit, static_argnames=("self",))
    def step(
        self, key: jax.Array, state: Any, action: jax.Array, params: EnvParams | None = None
    ) -> Step:
        """Return observation, state, reward, terminated, truncated and info, with auto-reset.

        gymnax's protocol, except that the whole key serves the reset: what a step draws, it draws
        from the word that the episode began with. The types are those of the state, float32 from a
        reset: the action is cast to them.
        """
        if params is None:
            params = self.default_params
        return self._fly(seed_of(key), state, action, params)

    def _transition(self, state: Any, command: Action, params: EnvParams) -> tuple[Any, ...]:
        """Return observation rows, state, reward, flags and info of a step without auto-reset."""
        next_state, reward, terminated, info = self.advance(state, command, params)
        next_state, reward = _keep_types(next_state, state), jnp.asarray(reward, self._dtype(state))
        rows = self._rows(next_state, params)
        rows, next_state = self._apply_transition_gradient_policy(rows, next_state)
        flags = {"terminated": terminated, "truncated": self.is_truncated(next_state, params)}
        return rows, next_state, reward, flags, info

    def _transition_or_reset(
        self, seed: jax.Array, state: Any, command: Action, params: EnvParams, has_ended: Any
    ) -> tuple[Any, ...]:
        """Return observation rows, those before the reset, state, reward, flags and info."""
        final_rows, next_state, reward, flags, info = self._transition(state, command, params)
        if has_ended is None:
            done = flags["terminated"] | flags["truncated"]
        else:
            done, reward = has_ended, jnp.where(has_ended, 0.0, reward)
            flags = {name: flag & ~has_ended for name, flag in flags.items()}
        ended = Ended(compute_once(done), (final_rows, next_state), seed)
        rows, next_state = reset_if_ended(self._begin_from, ended, params)
        return rows, final_rows, next_state, reward, flags, info

    @partial(jax.jit, static_argnames=("self",))
    def step_batch(
        self,
        key: jax.Array,
        states: Any,
        actions: jax.Array,
        params: EnvParams,
        has_ended: jax.Array | None = None,
    ) -> Step:
        """Step a whole batch with one key, faster than ``vmap(step)``.

        The results are those of ``vmap(step)`` up to the random draws: starts are sampled only in
        steps where an episode ended.

        Args:
            states: leaves (num_envs,).
            actions: (num_envs, 4).
            params: the same for all.
            has_ended: None, or (num_envs,) bool to reset one step late: an environment whose
                episode ended in the step before is reset instead of stepped, with a reward of 0,
                both flags False and a meaningless info.
        """
        seeds = seeds_of(seed_of(key), jnp.arange(actions.shape[0]))
        step = jax.vmap(self._fly, in_axes=(0, 0, 0, None, 0))
        return step(seeds, states, actions, params, has_ended)

    def _fly(
        self,
        seed: jax.Array,
        state: Any,
        action: jax.Array,
        params: EnvParams,
        has_ended: Any = None,
    ) -> Step:
        """Return what ``step`` does, of an action (4,) and one random word."""
        outcome = one_kernel(self._transition_or_reset)(
            seed, state, clip_action(action, self._dtype(state)), params, has_ended
        )
        rows, final_rows, state, reward, flags, info = outcome
        info = {**info, **flags, "final_observation": self.compose(final_rows, params)}
        observation = self.compose(rows, params)
        return observation, state, reward, flags["terminated"], flags["truncated"], info
