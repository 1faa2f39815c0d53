"""Many environments behind ``gymnasium.make_vec``: one compiled step for all of them."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from flytrack_env.env import EnvParams
from flytrack_env.gymnasium_adapter.common import as_float32, box, check_render_mode, metadata_of
from flytrack_env.gymnasium_adapter.options import TRACK, check_names, read_start
from flytrack_env.gymnasium_adapter.simulation import Simulation, draw_key
from flytrack_env.rendering import FlightLog, make_renderer

RENDER_MODES = ("rgb_array",)
SEED_WORDS = 4
MOST_STEPS = 2**32  # that a word tells apart


class FlyTrackVectorEnv(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Environments of one id side by side; an ended episode begins anew in the same step.

    What ``gymnasium.vector.SyncVectorEnv`` with ``AutoresetMode.SAME_STEP`` returns, in the same types:
    new, writable arrays in every step.

    Args:
        env_id: an id of ``flytrack_env.registration.ENVIRONMENTS``.
        num_envs: how many.
        render_mode: None or "rgb_array".
        params: replace the environment's default parameters.
        overrides: further arguments of ``flytrack_env.make``: track, model, plant, missed_gate, reward.

    Raises:
        ValueError: what ``flytrack_env.make`` and ``check_params`` refuse, an unknown render mode, or no
            environments.
        TypeError: params of another type.
        ImportError: a render mode without Pillow.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # as Gymnasium declares it
        "render_modes": list(RENDER_MODES),
        "render_fps": 100,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        env_id: str,
        num_envs: int = 1,
        render_mode: str | None = None,
        params: EnvParams | None = None,
        **overrides: Any,
    ):
        if not isinstance(num_envs, int) or num_envs < 1:
            raise ValueError(f"num_envs: found {num_envs!r}, expected an integer of at least 1")
        check_render_mode(render_mode, RENDER_MODES)
        self.num_envs, self.render_mode = num_envs, render_mode
        self._simulation = Simulation(env_id, params, overrides)
        self.metadata = {**self.metadata, **metadata_of(self._simulation, RENDER_MODES)}
        env, params = self._simulation.env, self._simulation.params
        self.single_observation_space = box(env.observation_space(params))
        self.single_action_space = box(env.action_space(params))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._states: Any = None
        self._words = np.zeros(0, np.uint32)
        self._count = 0
        self._logs: list[FlightLog] = []
        self._renderer = None if render_mode is None else make_renderer(params.course)

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Return observations and an empty info of episodes that begin, in all environments.

        seed: of the first environment, the others counting up; or one per environment. An environment's
        start is that of a single environment with its seed. options: as for the single environment, the
        same for all.

        Raises:
            ValueError: an unknown option, a value that no episode can start with, or another number of
                seeds.
        """
        options = check_names(options)
        simulation = self._simulation
        if TRACK in options:
            simulation = simulation.with_track(options[TRACK])
        start = read_start(options, simulation.params.course)
        words = self._seed(seed)
        if simulation is not self._simulation:
            self._simulation = simulation
            self._renderer = self._renderer and make_renderer(simulation.params.course)
        self._states, observations, scenes = simulation.begin(words, start)
        self._words, self._count = draw_key(self.np_random), 0
        if self._renderer is not None:
            self._log(np.asarray(scenes), np.ones(self.num_envs, bool))
        return np.array(observations), {}

    def _seed(self, seed: Any) -> np.ndarray:
        """Seed the generator and return a key's words per environment."""
        if seed is None:
            return draw_key(self.np_random, (self.num_envs,))
        if isinstance(seed, (int, np.integer)):
            seeds: list[int | None] = [int(seed) + index for index in range(self.num_envs)]
        else:
            seeds = [one if one is None else int(one) for one in seed]
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: found {len(seeds)} seeds, expected one per environment, {self.num_envs}")
        words = np.stack([draw_key(seeding.np_random(one)[0]) for one in seeds])
        # The draws after this one depend on all seeds; Gymnasium's generator takes one integer.
        common = np.random.SeedSequence(words.ravel().tolist()).generate_state(SEED_WORDS)
        super().reset(seed=int.from_bytes(common.tobytes(), "little"))
        return words

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Return observations, rewards, terminations, truncations and infos of a step.

        actions: (num_envs, 4). Where an episode ended, the observation is that of the next one, and infos
        has ``final_obs`` and ``final_info`` with their masks.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
            ValueError: actions of another shape.
        """
        if self._states is None:
            raise gymnasium.error.ResetNeeded("step: found no episodes, expected a reset before it")
        actions = as_float32(actions)
        if actions.shape != self.action_space.shape:
            raise ValueError(f"actions: found shape {actions.shape}, expected {self.action_space.shape}")
        programs = self._simulation.programs
        self._states, observations, final_observations, scenes, blocks = programs.step_batch(
            self._states,
            self._words,
            np.uint32(self._count),
            actions,
            self._simulation.packed_params,
            self._renderer is not None,
        )
        self._count = (self._count + 1) % MOST_STEPS
        columns = programs.batch_columns.batched(blocks)
        rewards, terminated, truncated, infos, final_info, final_masks = columns
        done = terminated | truncated
        if self._renderer is not None:
            self._log(np.asarray(scenes), done)
        places = np.flatnonzero(done)
        if places.size:
            infos = {} if done.all() else infos
            final_obs = np.empty(self.num_envs, object)  # filled with None
            for place, final in zip(places.tolist(), np.asarray(final_observations)[places], strict=True):
                final_obs[place] = final
            infos.update(final_obs=final_obs, final_info=final_info, **final_masks)
        return np.array(observations), rewards, terminated, truncated, infos

    def _log(self, scenes: np.ndarray, has_begun: np.ndarray) -> None:
        """Log what pictures need, in new logs where episodes began."""
        step_s = float(self._simulation.params.dt)
        logs = self._logs or [FlightLog(step_s)] * self.num_envs
        self._logs = [
            FlightLog(step_s) if is_new else log for log, is_new in zip(logs, has_begun.tolist(), strict=True)
        ]
        for log, scene in zip(self._logs, scenes, strict=True):
            log.append(scene)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a picture (540, 960, 3), uint8, per environment in mode "rgb_array"; else None.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
        """
        if self._renderer is None:
            return None
        if self._states is None:
            raise gymnasium.error.ResetNeeded("render: found no episodes, expected a reset before it")
        return tuple(self._renderer.draw(log) for log in self._logs)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy needs: what draws pictures is made anew."""
        return {**self.__dict__, "_renderer": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take over what a copy needs."""
        self.__dict__.update(state)
        if self.render_mode is not None:
            self._renderer = make_renderer(self._simulation.params.course)
