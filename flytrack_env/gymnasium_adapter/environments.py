"""The environments behind ``gymnasium.make`` and ``gymnasium.make_vec``: one compiled step each."""

from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from gymnax.environments.spaces import gymnax_space_to_gym_space

from flytrack_env.env import EnvParams
from flytrack_env.gymnasium_adapter.options import TRACK, check_names, read_start
from flytrack_env.gymnasium_adapter.packing import WORD, Layout
from flytrack_env.gymnasium_adapter.simulation import (
    Simulation,
    SingleStep,
    begin,
    draw_key,
    single_step,
    step_batch,
)
from flytrack_env.messages import check_keywords
from flytrack_env.registration import ARGUMENTS
from flytrack_env.rendering import FlightLog, can_render, open_window

RENDER_MODES, VECTOR_RENDER_MODES = ("human", "rgb_array"), ("rgb_array",)
AUTORESET_MODES = AutoresetMode.NEXT_STEP.value, AutoresetMode.SAME_STEP.value
SEED_WORDS = 4
NONE_BEGAN = np.zeros(1, bool)
MAX_COUNT = 2**32  # that a uint32 can count


class _Adapter:
    """What the single and the vector environment share: simulation, spaces and pictures."""

    metadata: dict[str, Any]
    render_mode: str | None
    _simulation: Simulation
    _renderer: Any
    _window: Any
    _states: Any  # packed, or the words of a single one's; None before the first reset
    _logs: dict[int, FlightLog]  # of pictures, by the environment's index

    def _set_up(
        self,
        env_id: str,
        render_mode: str | None,
        params: EnvParams | None,
        overrides: dict[str, Any],
    ) -> tuple[Any, ...]:
        """Make the simulation and its renderer; return the spaces of observation and action."""
        render_modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in render_modes:
            expected = ", ".join(map(repr, render_modes))
            raise ValueError(f"render_mode: found {render_mode!r}, expected None, {expected}")
        self.render_mode, self._states, self._logs = render_mode, None, {}
        self._simulation = simulation = Simulation(env_id, params, overrides)
        # The class announces every mode, so that asking for one that is missing says how to install
        # it.
        modes = [mode for mode in render_modes if can_render(mode)]
        self.metadata = self.metadata | {
            "render_modes": modes,
            "render_fps": round(1.0 / simulation.step_s),
        }
        self._open()
        spaces = simulation.env.observation_space(params), simulation.env.action_space(params)
        return tuple(map(gymnax_space_to_gym_space, spaces))

    def _open(self) -> None:
        """Make what draws pictures and shows them, if the mode has any."""
        self._renderer = None if self.render_mode is None else self._simulation.make_renderer()
        self._window = open_window(self._simulation.step_s) if self.render_mode == "human" else None

    def _begin(
        self, options: dict[str, Any] | None, draw_words: Callable[[], np.ndarray]
    ) -> np.ndarray:
        """Begin episodes by the options of a reset; return their observations, (num_envs, size).

        Args:
            draw_words: called for the words of their keys once the options are known to be good.
        """
        options, simulation = check_names(options), self._simulation
        if TRACK in options:
            simulation = simulation.with_track(options[TRACK])
        start = read_start(options, simulation.params.course, simulation.params.model.battery)
        words = draw_words()
        if simulation is not self._simulation:
            self._simulation = simulation
            self._renderer = self._renderer and simulation.make_renderer()
        self._states, observations, scenes = begin(
            simulation.compiled,
            words,
            start,
            simulation.packed_params,
            self._renderer is not None,
        )
        self._log(scenes, np.ones(len(words), bool))
        return np.array(observations)

    def _log(self, scenes: Any, has_begun: np.ndarray) -> None:
        """Log what pictures need, if there are any, in new logs where episodes began."""
        if self._renderer is None:
            return
        for index in np.flatnonzero(has_begun).tolist():
            self._logs[index] = FlightLog(self._simulation.step_s)
        for index, scene in enumerate(np.asarray(scenes)):
            self._logs[index].append(scene)

    def _check(self, name: str, actions: Any, shape: tuple[int, ...] | None) -> np.ndarray:
        """Return actions as float32, once an episode has begun and if they have that shape."""
        self._check_begun("step")
        if not (isinstance(actions, np.ndarray) and actions.dtype == WORD):
            with np.errstate(over="ignore"):  # beyond float32 is infinite, and clipped as such
                actions = np.asarray(actions, np.float32)
        if actions.shape != shape:
            raise ValueError(f"{name}: found shape {actions.shape}, expected {shape}")
        return actions

    def _check_begun(self, method: str) -> None:
        if self._states is None:
            raise gymnasium.error.ResetNeeded(
                f"{method}: found no episode, expected a reset before it"
            )

    def _draw_pictures(self) -> tuple[np.ndarray, ...] | None:
        """Return a picture per environment in mode "rgb_array", else None."""
        if self.render_mode != "rgb_array":
            return None
        self._check_begun("render")
        return tuple(self._renderer.draw(self._logs[index]) for index in sorted(self._logs))

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy needs: it gets a renderer and a window of its own."""
        return {**self.__dict__, "_renderer": None, "_window": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take over what a copy needs."""
        self.__dict__.update(state)
        self._open()


class FlyTrackEnv(_Adapter, gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment of an id, stepped as one compiled function.

    Args:
        env_id: of ``flytrack_env.registration.ENVIRONMENTS``.
        render_mode: None, "rgb_array" or "human".
        params: replace the default parameters.
        overrides: further arguments of ``flytrack_env.make``: track, model, plant, missed_gate,
            reward.

    Raises:
        ValueError, TypeError: what ``flytrack_env.make`` and ``check_params`` refuse, or a render
            mode.
        ImportError: a render mode whose package is not installed.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 100}  # noqa: RUF012  # as Gymnasium declares it

    _layout: Layout  # of a state

    def __init__(
        self,
        env_id: str,
        render_mode: str | None = None,
        params: EnvParams | None = None,
        **overrides: Any,
    ):
        check_keywords(overrides, ("render_mode", "params", *ARGUMENTS))
        self.observation_space, self.action_space = self._set_up(
            env_id, render_mode, params, overrides
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Return observation and an empty info of an episode that begins.

        Args:
            options: position (world, m), quaternion (w, x, y, z, body to world) or yaw_deg,
                velocity (world, m/s), battery_v, gate_index (to fly first), track; see
                docs/gymnasium.md.

        Raises:
            ValueError: an unknown option, or a value that no episode can start with.
        """

        def draw() -> np.ndarray:
            super(FlyTrackEnv, self).reset(seed=seed)
            return draw_key(self.np_random, (1,))

        observation = self._begin(options, draw)[0]
        self._layout = self._states.layout
        self._states = self._compiled_step().start(self._states)
        self._show()
        return observation, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Return observation, reward, terminated, truncated and info, of Python's own types.

        Args:
            action: (4,), see docs/environment.md. There is no auto-reset.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
            ValueError: an action of another shape.
        """
        action = self._check("action", action, self.action_space.shape)
        self._states, observation, reward, terminated, truncated, info, scene = (
            self._compiled_step()(self._states, action, self._simulation.params_words)
        )
        if self._renderer is not None:
            self._log([scene], NONE_BEGAN)
            self._show()
        return observation, reward, terminated, truncated, info

    def _compiled_step(self) -> SingleStep:
        simulation = self._simulation
        return single_step(
            simulation.compiled,
            self._layout,
            simulation.packed_params.layout,
            self._renderer is not None,
            jax.config.jax_enable_x64,  # type: ignore[attr-defined]  # added at run time
        )

    def _show(self) -> None:
        """Show the state in the window, if there is one."""
        if self._window is not None:
            log = self._logs[0]
            self._window.show(lambda: self._renderer.draw(log), is_first=len(log.rows) == 1)

    def render(self) -> np.ndarray | None:
        """Return a picture (540, 960, 3), uint8, in mode "rgb_array"; else None.

        In mode "human" the window has shown every step by itself.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
        """
        pictures = self._draw_pictures()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Close the window, if there is one; more than once is allowed."""
        if self._window is not None:
            self._window.close()
            self._window = None


class FlyTrackVectorEnv(_Adapter, gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Environments of one id side by side, each reset by itself after its episode ended.

    What ``gymnasium.vector.SyncVectorEnv`` returns in the same autoreset mode, in the same types:
    new, writable arrays in every step. Other arguments and errors are those of ``FlyTrackEnv``.

    Args:
        render_mode: None or "rgb_array".
        autoreset_mode: ``AutoresetMode.NEXT_STEP`` or ``SAME_STEP``, or its value.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # as Gymnasium declares it
        "render_modes": list(VECTOR_RENDER_MODES),
        "render_fps": 100,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        env_id: str,
        num_envs: int = 1,
        render_mode: str | None = None,
        params: EnvParams | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **overrides: Any,
    ):
        check_keywords(
            overrides, ("num_envs", "render_mode", "params", "autoreset_mode", *ARGUMENTS)
        )
        mode = getattr(autoreset_mode, "value", autoreset_mode)
        if mode not in AUTORESET_MODES:
            expected = " or ".join(map(repr, AUTORESET_MODES))
            raise ValueError(f"autoreset_mode: found {mode!r}, expected {expected}")
        if not isinstance(num_envs, (int, np.integer)) or num_envs < 1:
            raise ValueError(f"num_envs: found {num_envs!r}, expected an integer of at least 1")
        self.num_envs = int(num_envs)
        self.single_observation_space, self.single_action_space = self._set_up(
            env_id, render_mode, params, overrides
        )
        self.autoreset_mode = AutoresetMode(mode)  # where TorchRL looks for it
        self.metadata["autoreset_mode"] = self.autoreset_mode
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._words, self._count = np.zeros(0, np.uint32), 0
        self._has_ended: np.ndarray | None = None  # in the step before, in mode NEXT_STEP

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Return observations and an empty info of episodes that begin, in all environments.

        An environment's start is that of a single environment with its seed.

        Args:
            seed: of the first environment, the others counting up; or one per environment.
            options: as for the single environment, the same for all.

        Raises:
            ValueError: an unknown option, a value that no episode can start with, or another number
                of seeds.
        """
        observations = self._begin(options, lambda: self._seed(seed))
        self._words, self._count = draw_key(self.np_random), 0
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            self._has_ended = np.zeros(self.num_envs, bool)
        return observations, {}

    def _seed(self, seed: Any) -> np.ndarray:
        """Seed the generator and return a key's words per environment."""
        if seed is None:
            return draw_key(self.np_random, (self.num_envs,))
        if isinstance(seed, (int, np.integer)):
            seeds: list[int | None] = [int(seed) + index for index in range(self.num_envs)]
        else:
            seeds = [one if one is None else int(one) for one in seed]
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"seed: found {len(seeds)} seeds, expected one per environment, {self.num_envs}"
            )
        words = np.stack([draw_key(seeding.np_random(one)[0]) for one in seeds])
        # The draws after this one depend on all seeds; Gymnasium's generator takes one integer.
        common = np.random.SeedSequence(words.ravel().tolist()).generate_state(SEED_WORDS)
        super().reset(seed=int.from_bytes(common.tobytes(), "little"))
        return words

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Return observations, rewards, terminations, truncations and infos of a step.

        With ``NEXT_STEP``, where an episode ended in the step before, the action is ignored, and
        the observation is the first one of the next episode, with a reward of 0, no flag and no
        info. With ``SAME_STEP``, where an episode ends, the observation is the first one of the
        next episode, and infos has ``final_obs`` and ``final_info`` with their masks.

        Args:
            actions: (num_envs, 4).

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
            ValueError: actions of another shape.
        """
        actions = self._check("actions", actions, self.action_space.shape)
        simulation, has_ended = self._simulation, self._has_ended
        self._states, observations, final_observations, scenes, grouped = step_batch(
            simulation.compiled,
            self._states,
            self._words,
            np.uint32(self._count),
            actions,
            simulation.packed_params,
            has_ended,
            self._renderer is not None,
        )
        self._count = (self._count + 1) % MAX_COUNT
        rewards, terminated, truncated, infos, final_info, final_masks = grouped.to_host()
        done = terminated | truncated
        self._log(scenes, done if has_ended is None else has_ended)
        if has_ended is not None:
            self._has_ended = done
            infos = {} if has_ended.all() else infos
        elif done.any():
            indices, infos = np.flatnonzero(done), {} if done.all() else infos
            final_obs = np.empty(self.num_envs, object)  # filled with None
            for index, final in zip(
                indices.tolist(), np.asarray(final_observations)[indices], strict=True
            ):
                final_obs[index] = final
            infos.update(final_obs=final_obs, final_info=final_info, **final_masks)
        return np.array(observations), rewards, terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a picture (540, 960, 3), uint8, per environment in mode "rgb_array"; else None.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
        """
        return self._draw_pictures()
