"""One environment behind ``gymnasium.make``."""

from typing import Any

import gymnasium
import numpy as np

from flytrack_env.env import EnvParams
from flytrack_env.gymnasium_adapter.common import as_float32, box, check_render_mode, metadata_of
from flytrack_env.gymnasium_adapter.options import TRACK, check_names, read_start
from flytrack_env.gymnasium_adapter.simulation import Simulation, draw_key
from flytrack_env.rendering import FlightLog, make_renderer, open_window

RENDER_MODES = ("human", "rgb_array")


class FlyTrackEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment of an id, stepped as one compiled function.

    Args:
        env_id: an id of ``flytrack_env.registration.ENVIRONMENTS``.
        render_mode: None, "rgb_array" or "human".
        params: replace the environment's default parameters.
        overrides: further arguments of ``flytrack_env.make``: track, model, plant, missed_gate, reward.

    Raises:
        ValueError: what ``flytrack_env.make`` and ``check_params`` refuse, or an unknown render mode.
        TypeError: params of another type.
        ImportError: a render mode whose package is not installed.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 100}  # noqa: RUF012  # as Gymnasium declares it

    def __init__(
        self,
        env_id: str,
        render_mode: str | None = None,
        params: EnvParams | None = None,
        **overrides: Any,
    ):
        check_render_mode(render_mode, RENDER_MODES)
        self.render_mode = render_mode
        self._simulation = Simulation(env_id, params, overrides)
        self.metadata = metadata_of(self._simulation, RENDER_MODES)
        env, params = self._simulation.env, self._simulation.params
        self.observation_space = box(env.observation_space(params))
        self.action_space = box(env.action_space(params))
        self._state: Any = None
        self._log = FlightLog(float(params.dt))
        self._renderer = None if render_mode is None else make_renderer(params.course)
        self._window = open_window(float(params.dt)) if render_mode == "human" else None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Return observation and an empty info of an episode that begins.

        options: position (world, m), quaternion (w, x, y, z, body to world) or yaw_deg, velocity
        (world, m/s), battery_v, gate_index (to fly first), track; see docs/gymnasium.md.

        Raises:
            ValueError: an unknown option, or a value that no episode can start with.
        """
        options = check_names(options)
        simulation = self._simulation
        if TRACK in options:
            simulation = simulation.with_track(options[TRACK])
        start = read_start(options, simulation.params.course)
        super().reset(seed=seed)
        if simulation is not self._simulation:
            self._simulation = simulation
            self._renderer = self._renderer and make_renderer(simulation.params.course)
        self._state, observation, scene = simulation.begin(draw_key(self.np_random), start)
        self._log = FlightLog(float(simulation.params.dt))
        self._show(scene)
        return np.array(observation), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Return observation, reward, terminated, truncated and info, of Python's own types.

        action: (4,), see docs/environment.md. Nothing is reset by itself.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
            ValueError: an action of another shape.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("step: found no episode, expected a reset before it")
        action = as_float32(action)
        if action.shape != self.action_space.shape:
            raise ValueError(f"action: found shape {action.shape}, expected {self.action_space.shape}")
        programs = self._simulation.programs
        outputs = programs.step(self._state, action, self._simulation.packed_params)
        self._state, observation, scene, blocks = outputs
        reward, terminated, truncated, info = programs.columns.plain(blocks)
        self._show(scene)
        return np.array(observation), reward, terminated, truncated, info

    def _show(self, scene: Any) -> None:
        """Log what a picture needs, and show it in the window if there is one."""
        renderer = self._renderer
        if renderer is None:
            return
        self._log.append(np.asarray(scene))
        if self._window is not None:
            self._window.show(lambda: renderer.draw(self._log), is_first=len(self._log.rows) == 1)

    def render(self) -> np.ndarray | None:
        """Return a picture (540, 960, 3), uint8, in mode "rgb_array"; else None.

        In mode "human" the window has shown every step by itself.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
        """
        if self.render_mode != "rgb_array" or self._renderer is None:
            return None
        if self._state is None:
            raise gymnasium.error.ResetNeeded("render: found no episode, expected a reset before it")
        return self._renderer.draw(self._log)

    def close(self) -> None:
        """Close the window, if there is one; more than once is allowed."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy needs: pictures and windows are made anew."""
        return {**self.__dict__, "_renderer": None, "_window": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take over what a copy needs."""
        self.__dict__.update(state)
        params = self._simulation.params
        if self.render_mode is not None:
            self._renderer = make_renderer(params.course)
        if self.render_mode == "human":
            self._window = open_window(float(params.dt))
