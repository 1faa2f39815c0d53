"""An environment with parameters, as compiled functions that take and give few arrays."""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.env import EnvParams
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.gymnasium_adapter.packing import Columns, Layout, Packed
from flytrack_env.randomness import seed_of
from flytrack_env.registration import make
from flytrack_env.rendering import make_renderer, scene_row
from flytrack_env.rendering.flight_log import GATE_INDEX
from flytrack_env.state import BATTERY, STATE_SIZE, unpack
from flytrack_env.tracks import Track, build_course, load_track

KEY_WORDS = 2  # uint32 words of a random key
NOT_INFO = ("terminated", "truncated", "final_observation")  # of step_batch's info; returned separately


def draw_key(generator: np.random.Generator, shape: tuple[int, ...] = ()) -> np.ndarray:
    """Return the words of a random key, (*shape, KEY_WORDS), uint32."""
    return generator.integers(0, 2**32, (*shape, KEY_WORDS), np.uint32)


def _grouped(
    reward: jax.Array, terminated: jax.Array, truncated: jax.Array, info: dict[str, Any], has_ended: Any
) -> Any:
    """Return what a vector environment gives of one environment's step, as ``SyncVectorEnv`` groups it.

    Reward, flags, the infos of an episode that goes on, the final infos of one that ended, and the masks
    of the latter. A mask says where the value of its name, less the underscore, is given; elsewhere it is 0.
    has_ended: None; or whether this is the reset after an end, which has no infos, and then nothing is final.
    """

    def masked(mask: jax.Array) -> dict[str, jax.Array]:
        values = {name: jnp.where(mask, value, jnp.zeros_like(value)) for name, value in info.items()}
        return values | {f"_{name}": mask for name in info}

    if has_ended is not None:
        return reward, terminated, truncated, masked(~has_ended), {}, {}
    done = terminated | truncated
    final_masks = {"_final_obs": done, "_final_info": done}
    return reward, terminated, truncated, masked(~done), masked(done), final_masks


class Programs:
    """Compiled functions of an environment for parameters of one structure.

    state: of an episode, arrays or shapes. States and parameters go in and out packed.
    """

    def __init__(self, env: EpisodicEnvironment, params: EnvParams, state: Any):
        self.env = env
        self.params_layout, self.state_layout = Layout.of(params), Layout.of(state)
        action = jax.ShapeDtypeStruct(env.action_space(params).shape, jnp.float32)
        outcome = jax.eval_shape(partial(self._outcome, params=params), state, action)[2]
        self.columns = Columns(outcome)
        self.same_step_columns = Columns(jax.eval_shape(_grouped, *outcome, None))
        self.next_step_columns = Columns(jax.eval_shape(_grouped, *outcome, outcome[1]))

    def _outcome(
        self, state: Any, action: jax.Array, params: EnvParams
    ) -> tuple[jax.Array, Any, tuple[Any, ...]]:
        """Return observation, state, and (reward, terminated, truncated, info) of a step."""
        observation, state, reward, terminated, info = self.env.step_env(None, state, action, params)
        return observation, state, (reward, terminated, self.env.is_truncated(state, params), info)

    def _scene(self, state: Any) -> jax.Array:
        return scene_row(self.env.drone(state), self.env.race(state))

    @partial(jax.jit, static_argnums=0)
    def pack_params(self, params: EnvParams) -> Packed:
        """Return the parameters as the other functions take them."""
        return self.params_layout.pack(params)

    @partial(jax.jit, static_argnums=0)
    def begin(
        self, words: jax.Array, start: tuple[Any, ...], params: Packed
    ) -> tuple[Packed, jax.Array, jax.Array]:
        """Return state, observation and scene of an episode that begins, or of a batch of them.

        words: of a key, (KEY_WORDS,), or (num_envs, KEY_WORDS) for a batch. start: the drone (21,) and the
        index of the gate to fly first, of each; empty: drawn.
        """
        unpacked = self.params_layout.unpack(params)

        def begin_one(words: jax.Array, *start: Any) -> tuple[Any, jax.Array, jax.Array]:
            key = jax.random.wrap_key_data(words, impl="threefry2x32")
            if start:
                state = self.env.begin(unpack(start[0]), start[1], unpacked, seed_of(key))
                observation = self.env.observe(None, state, None, unpacked)
            else:
                observation, state = self.env.reset(key, unpacked)
            return state, observation, self._scene(state)

        is_batch = words.ndim > 1
        states, observations, scenes = (jax.vmap(begin_one) if is_batch else begin_one)(words, *start)
        pack = self.state_layout.pack_batch if is_batch else self.state_layout.pack
        return pack(states), observations, scenes

    @partial(jax.jit, static_argnums=0)
    def step(self, state: Packed, action: jax.Array, params: Packed) -> tuple[Any, ...]:
        """Return state, observation, scene, and the blocks of ``columns``."""
        observation, new_state, outcome = self._outcome(
            self.state_layout.unpack(state), action, self.params_layout.unpack(params)
        )
        blocks = self.columns.gather(outcome)
        return self.state_layout.pack(new_state), observation, self._scene(new_state), blocks

    def columns_of(self, has_ended: Any) -> Columns:
        """Return the columns of ``step_batch``."""
        return self.same_step_columns if has_ended is None else self.next_step_columns

    @partial(jax.jit, static_argnums=(0, 7))
    def step_batch(
        self,
        states: Packed,
        words: jax.Array,
        count: Any,
        actions: jax.Array,
        params: Packed,
        has_ended: jax.Array | None,
        has_scenes: bool,
    ) -> tuple[Any, ...]:
        """Return states, observations, final observations, scenes, and the blocks of ``columns_of``.

        The auto-resetting step of a batch. words: of one key for all; count: makes it this step's own.
        has_ended: None to reset in this step, or (num_envs,) bool for those that ended in the step before.
        scenes: (num_envs, SCENE_SIZE) after the auto-reset if they are asked for, else None.
        """
        key = jax.random.fold_in(jax.random.wrap_key_data(words, impl="threefry2x32"), count)
        unpacked = self.state_layout.unpack_batch(states), actions, self.params_layout.unpack(params)
        step = self.env.step_batch(key, *unpacked, has_ended)
        observations, new_states, rewards, terminated, truncated, info = step
        final_observations = info["final_observation"] if has_ended is None else None
        kept = {name: value for name, value in info.items() if name not in NOT_INFO}
        grouped = jax.vmap(_grouped)(rewards, terminated, truncated, kept, has_ended)
        blocks = self.columns_of(has_ended).gather(grouped, is_batch=True)
        scenes = jax.vmap(self._scene)(new_states) if has_scenes else None
        packed = self.state_layout.pack_batch(new_states)
        return packed, observations, final_observations, scenes, blocks


# By all that a compiled function depends on: id, missed gates, plant, the delay that the simulator of a model
# remembers, and the layout of the parameters.
_PROGRAMS: dict[Any, Programs] = {}
MOST_PROGRAMS = 16


class Simulation:
    """An environment of an id with its parameters. Never changes; copies share what is compiled.

    env_id, overrides: what ``flytrack_env.make`` takes. params: replace the defaults if not None.

    Raises:
        ValueError: what ``flytrack_env.make`` and ``check_params`` refuse, and leaves of another shape.
        TypeError: params of another type.
    """

    def __init__(self, env_id: str, params: EnvParams | None, overrides: dict[str, Any]):
        self.env_id, self.overrides = env_id, overrides
        self.env = make(env_id, **overrides)
        self.params = self.env.default_params if params is None else params
        _check_shapes(self.params, self.env.default_params)
        self.env.check_params(self.params)
        plant = overrides.get("plant")
        layout, delay_steps = Layout.of(self.params), self.env.plant.delay_steps
        key = env_id, self.env.missed_gate, plant and id(plant), delay_steps, layout
        if key not in _PROGRAMS:
            if len(_PROGRAMS) == MOST_PROGRAMS:
                del _PROGRAMS[next(iter(_PROGRAMS))]
            _, state = jax.eval_shape(self.env.reset, jax.random.key(0), self.params)
            _PROGRAMS[key] = Programs(self.env, self.params, state)  # keeps the plant, and so its id
        self.programs = _PROGRAMS[key]
        self.packed_params = self.programs.pack_params(self.params)

    def with_track(self, track: str | Path | Track) -> "Simulation":
        """Return the same on another track.

        Raises:
            TrackError: a track that cannot be read.
        """
        track = track if isinstance(track, Track) else load_track(track)
        params = self.params.replace(course=build_course(track))
        return Simulation(self.env_id, params, {**self.overrides, "track": track})

    def make_renderer(self) -> Any:
        """Return what draws flights, with the ids of the track's gates, or indices on any other course."""
        course, own = self.params.course, self.env.default_params.course
        is_own = jax.tree.all(jax.tree.map(np.array_equal, course, own))
        ids = [gate.id for gate in self.env.track.gates]
        return make_renderer(course, ids if is_own else range(course.num_gates))

    def begin(
        self, words: np.ndarray, drone: np.ndarray | None, gate_index: int, battery_v: float | None
    ) -> tuple[Packed, jax.Array, jax.Array]:
        """Return packed state, observation and scene of an episode that begins.

        words: of a key, (KEY_WORDS,); or (num_envs, KEY_WORDS) for the same of a batch. The rest is as from
        ``options.read_start``.
        """
        batch = words.shape[:-1]
        if drone is None:
            begun = self.programs.begin(words, (), self.packed_params)
            if battery_v is None:
                return begun
            scenes = np.array(begun[2])
            drones, gate_indices = scenes[..., :STATE_SIZE], scenes[..., GATE_INDEX].astype(np.int32)
        else:
            drones = np.tile(drone, (*batch, 1))
            gate_indices = np.full(batch, gate_index, np.int32)
        if battery_v is not None:
            drones[..., BATTERY] = battery_v
        return self.programs.begin(words, (drones, gate_indices), self.packed_params)

    def __deepcopy__(self, memo: dict[int, Any]) -> "Simulation":
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return Simulation, (self.env_id, self.params, self.overrides)


def _check_shapes(params: EnvParams, default: EnvParams) -> None:
    """Raise unless it is an unbatched EnvParams; a course may have any number of gates."""
    if not isinstance(params, EnvParams):
        raise TypeError(f"params: found {type(params).__name__}, expected EnvParams")
    params = params.replace(course=default.course)
    if jax.tree.structure(params) != jax.tree.structure(default):  # type: ignore[operator]  # jaxlib's stub has no !=
        return  # other effects, say
    found = jax.tree_util.tree_leaves_with_path(params)
    for (path, leaf), expected in zip(found, jax.tree.leaves(default), strict=True):
        if np.shape(leaf) != np.shape(expected):
            name = f"params{jax.tree_util.keystr(path)}"
            raise ValueError(f"{name}: found shape {np.shape(leaf)}, expected {np.shape(expected)}")
