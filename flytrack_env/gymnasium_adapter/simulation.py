"""An environment with parameters, and its compiled functions: batches move as few arrays."""

from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flytrack_env.env import EnvParams
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.fusion import UNFUSED, has_kernels, one_kernel, unfused
from flytrack_env.gymnasium_adapter.packing import (
    WORD,
    Layout,
    Packed,
    from_words,
    make_reader,
    pack,
    pack_one,
)
from flytrack_env.randomness import seed_of
from flytrack_env.registration import make
from flytrack_env.rendering import make_renderer, scene_row
from flytrack_env.state import ACTION_SIZE, unpack
from flytrack_env.tracks import Track, build_course, load_track

MAX_INLINE_OPERATIONS = 1000  # cheap_computation of xla/pjrt/cpu/cpu_client.cc
KEY_WORDS = 2  # uint32 words of a random key
NOT_INFO = (
    "terminated",
    "truncated",
    "final_observation",
)  # of step_batch's info; returned separately


def draw_key(generator: np.random.Generator, shape: tuple[int, ...] = ()) -> np.ndarray:
    """Return the words of a random key, (*shape, KEY_WORDS), uint32."""
    return generator.integers(0, 2**32, (*shape, KEY_WORDS), np.uint32)


def _make_key(words: jax.Array) -> jax.Array:
    return jax.random.wrap_key_data(words, impl="threefry2x32")


def _scene(env: EpisodicEnvironment, state: Any) -> jax.Array:
    return scene_row(env.drone(state), env.race(state))


@partial(jax.jit, static_argnums=(0, 4))
def begin(
    env: EpisodicEnvironment,
    words: jax.Array,
    start: dict[str, Any],
    params: Packed,
    has_scenes: bool,
) -> tuple[Packed, jax.Array, jax.Array | None]:
    """Return states, observations and scenes of episodes that begin.

    Scenes are None unless they are needed.

    Args:
        words: of their keys, (num_envs, KEY_WORDS).
        start: as of ``options.read_start``, the same for all.
    """

    @one_kernel
    def begin_all(words: jax.Array, start: dict[str, Any], params: Packed) -> tuple[Any, ...]:
        unpacked = params.unpack_one()

        def begin_one(words: jax.Array) -> tuple[Any, ...]:
            seed = seed_of(words)
            drone, gate_index = env.sample_start(seed, unpacked)
            if "drone" in start:
                drone, gate_index = unpack(start["drone"]), start["gate_index"]
            if "battery_v" in start:
                drone = drone._replace(battery_v=start["battery_v"])
            state = env.begin(drone, gate_index, unpacked, seed)
            scene = _scene(env, state) if has_scenes else None
            return state, env.observe(None, state, None, unpacked), scene

        states, observations, scenes = jax.vmap(begin_one)(words)
        return pack(states), observations, scenes

    result: tuple[Packed, jax.Array, jax.Array | None] = begin_all(words, start, params)
    return result


class SingleStep:
    """A step of one environment without auto-reset, as one kernel where it can be.

    It takes and returns one array: the words of the state, and below them what the step before
    returned. Each further array would cost four microseconds.

    Args:
        state: layout of a state.
        params: layout of the parameters.
        has_scene: whether scenes are needed.
        has_x64: whether JAX has 64-bit numbers, on which the layout of the results depends.
    """

    def __init__(
        self,
        env: EpisodicEnvironment,
        state: Layout,
        params: Layout,
        has_scene: bool,
        has_x64: bool,
    ):
        del has_x64  # JAX knows; here it tells one step from another

        def fly(state_words: Any, action: jax.Array, params_words: Any) -> tuple[Any, ...]:
            unpacked = from_words(params_words, params).unpack_one()
            before = from_words(state_words, state).unpack_one()
            observation, after, reward, terminated, info = env.step_env(
                None, before, action, unpacked
            )
            scene: Any = _scene(env, after) if has_scene else jnp.zeros(0)
            numbers = reward, terminated, env.is_truncated(after, unpacked), info
            return pack_one(after), observation, scene, pack_one(numbers)

        shapes = (state.num_rows, 1), (ACTION_SIZE,), (params.num_rows, 1)
        inputs = [jax.ShapeDtypeStruct(shape, WORD) for shape in shapes]
        _, observation, scene, numbers = jax.eval_shape(fly, *inputs)
        ends = np.cumsum([state.num_rows, observation.size, scene.size]).tolist()
        self._observation, self._scene = slice(ends[0], ends[1]), slice(ends[1], ends[2])
        self._shape, self._dtype = observation.shape, observation.dtype
        self._num_rows = ends[2] + numbers.layout.num_rows
        self._read = make_reader(numbers.layout, ends[2])
        indices = range(len(numbers.layout.slots))
        self._names = list(numbers.layout.structure.unflatten(indices)[-1])

        def fly_words(words: Any, action: jax.Array, params_words: Any) -> jax.Array:
            after, observation, scene, numbers = fly(words, action, params_words)
            rows = observation.reshape(-1, 1), scene[:, None]
            arrays = after.words, *rows, numbers.words
            return jnp.concatenate([array.astype(WORD) for array in arrays])

        inputs[0] = jax.ShapeDtypeStruct((self._num_rows, 1), WORD)
        self.compiled = _compile_unfused(fly_words, inputs) or jax.jit(one_kernel(fly_words))

    def start(self, state: Packed) -> np.ndarray:
        """Return the words of a state before the first step."""
        words = np.asarray(state.words)
        return np.concatenate([words, np.zeros((self._num_rows - len(words), 1), WORD)])

    def __call__(self, words: Any, action: np.ndarray, params_words: Any) -> tuple[Any, ...]:
        """Return words, observation, reward, terminated, truncated, info and scene of a step.

        In Python's own types and new arrays, but for the words.
        """
        words = self.compiled(words, action, params_words)
        column = np.asarray(words)[:, 0]
        reward, terminated, truncated, *values = self._read(column)
        info = dict(zip(self._names, values, strict=True))
        observation = column[self._observation].reshape(self._shape).astype(self._dtype)
        return words, observation, reward, terminated, truncated, info, column[self._scene]


def _compile_unfused(function: Any, inputs: Sequence[Any]) -> Any:
    """Return a function of few operations compiled to run on the thread that calls it, or None.

    XLA's client for CPUs hands programs of ``MAX_INLINE_OPERATIONS`` or more to another thread, and
    waiting for it costs more than this whole step. Without fusion nothing is computed twice, which
    keeps a step without noise and randomisation below that.
    """
    if not has_kernels():
        return None

    def traced(*args: Any) -> Any:
        with unfused():
            return function(*args)

    def count_operations(program: Any) -> float:
        return float((program.cost_analysis() or {}).get("flops", np.inf))

    compiled = jax.jit(one_kernel(traced), compiler_options=UNFUSED)
    lowered = compiled.lower(*inputs)
    # XLA's simplifications remove up to a third.
    if count_operations(lowered) >= 1.5 * MAX_INLINE_OPERATIONS:
        return None
    is_inline = count_operations(lowered.compile()) < MAX_INLINE_OPERATIONS
    return compiled if is_inline else None


single_step = cache(SingleStep)


@partial(jax.jit, static_argnums=(0, 7))
def step_batch(
    env: EpisodicEnvironment,
    states: Packed,
    words: jax.Array,
    count: Any,
    actions: jax.Array,
    params: Packed,
    has_ended: jax.Array | None,
    has_scenes: bool,
) -> tuple[Packed, jax.Array, jax.Array | None, jax.Array | None, Packed]:
    """Step a batch with auto-reset.

    Return states, observations, final observations, scenes, and what ``_group`` makes of the rest.
    Scenes, after the auto-reset, are None unless they are needed.

    Args:
        words: of one key for all.
        count: of steps, with which the key is this step's own.
        has_ended: None to reset in this step, or (num_envs,) bool for those that ended in the step
            before.
    """
    key = jax.random.fold_in(_make_key(words), count)
    outcome = env.step_batch(key, states.unpack(), actions, params.unpack_one(), has_ended)
    observations, after, rewards, terminated, truncated, info = outcome
    final_observations = info["final_observation"] if has_ended is None else None
    info = {name: value for name, value in info.items() if name not in NOT_INFO}
    grouped = jax.vmap(_group)(rewards, terminated, truncated, info, has_ended)
    scenes = jax.vmap(partial(_scene, env))(after) if has_scenes else None
    return pack(after), observations, final_observations, scenes, pack(grouped)


def _group(
    reward: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    info: dict[str, Any],
    has_ended: Any,
) -> Any:
    """Return a vector environment's outputs of one environment, grouped as ``SyncVectorEnv`` does.

    Reward, flags, the infos of an episode that goes on, the final infos of one that ended, and the
    masks of the latter. A mask says where the value of its name, less the underscore, is given;
    elsewhere it is 0.

    Args:
        has_ended: None; or whether this is the reset after an end, which has no infos, and then
            nothing is final.
    """

    def masked(mask: jax.Array) -> dict[str, jax.Array]:
        values = {
            name: jnp.where(mask, value, jnp.zeros_like(value)) for name, value in info.items()
        }
        return values | {f"_{name}": mask for name in info}

    if has_ended is not None:
        return reward, terminated, truncated, masked(~has_ended), {}, {}
    done = terminated | truncated
    final_masks = {"_final_obs": done, "_final_info": done}
    return reward, terminated, truncated, masked(~done), masked(done), final_masks


_pack_params = jax.jit(pack_one)

# By all that a compiled function depends on: id, missed gates, plant, the delay that the simulator
# of a model remembers, and the layout of the parameters. An environment keeps its plant, and so the
# plant's id.
_COMPILED: dict[Any, EpisodicEnvironment] = {}


class Simulation:
    """An environment of an id with its parameters. Never changes; copies share what is compiled.

    Args:
        env_id: of ``flytrack_env.make``.
        overrides: its other arguments.
        params: replace the defaults if not None.

    Raises:
        ValueError: what ``flytrack_env.make`` and ``check_params`` refuse, and leaves of another
            shape.
        TypeError: params of another type.
    """

    def __init__(self, env_id: str, params: EnvParams | None, overrides: dict[str, Any]):
        self.env_id, self.overrides = env_id, overrides
        self.env = make(env_id, **overrides)
        self.params = self.env.default_params if params is None else params
        _check_shapes(self.params, self.env.default_params)
        self.env.check_params(self.params)
        self.step_s = float(self.params.dt)
        # As arrays of NumPy: a number of Python's and one of NumPy's would be compiled apart.
        self.packed_params = _pack_params(jax.tree.map(np.asarray, self.params))
        self.params_words = self.packed_params.words
        plant = overrides.get("plant")
        key = env_id, self.env.missed_gate, plant and id(plant), self.env.plant.delay_steps
        self.compiled = _COMPILED.setdefault((*key, self.packed_params.layout), self.env)

    def with_track(self, track: str | Path | Track) -> "Simulation":
        """Return the same on another track.

        Raises:
            TrackError: a track that cannot be read.
        """
        track = track if isinstance(track, Track) else load_track(track)
        params = self.params.replace(course=build_course(track))
        return Simulation(self.env_id, params, {**self.overrides, "track": track})

    def make_renderer(self) -> Any:
        """Return a renderer with the ids of the track's gates, or indices on any other course."""
        course, default = self.params.course, self.env.default_params.course
        is_default = jax.tree.all(jax.tree.map(np.array_equal, course, default))
        ids = [gate.id for gate in self.env.track.gates]
        return make_renderer(course, ids if is_default else range(course.num_gates))

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
    leaves = jax.tree_util.tree_leaves_with_path(params)
    for (path, leaf), expected in zip(leaves, jax.tree.leaves(default), strict=True):
        if np.shape(leaf) != np.shape(expected):
            name = f"params{jax.tree_util.keystr(path)}"
            raise ValueError(f"{name}: found shape {np.shape(leaf)}, expected {np.shape(expected)}")
