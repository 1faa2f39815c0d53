"""A Gymnasium vector environment as a vector environment of Stable-Baselines3."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv


class SameStepVecEnv(VecEnv):
    """Adapt a Gymnasium vector environment that resets in the same step to Stable-Baselines3.

    Only infos of ended episodes are passed on, with ``terminal_observation`` and
    ``TimeLimit.truncated``; the others are empty, because a dict per environment and step costs
    more than the step. Raises ValueError for an environment that does not reset in the same step.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any]):
        mode = env.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(
                f"env: found autoreset_mode {mode}, expected {AutoresetMode.SAME_STEP}"
            )
        self.env = env
        self._actions = np.zeros(0)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> np.ndarray:
        """Return the first observations of new episodes, with the seeds and options set before."""
        # Stable-Baselines3 has a None per environment where Gymnasium has a single None.
        seeds: Any = None if None in self._seeds else list(self._seeds)
        if any(options != self._options[0] for options in self._options):
            raise ValueError(
                f"options: found {self._options}, expected the same for every environment"
            )
        observations, _ = self.env.reset(seed=seeds, options=self._options[0] or None)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions of the next step, (num_envs, ...)."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Return observations, rewards, dones and infos."""
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        done = terminated | truncated
        infos_of_envs: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(done).tolist():
            infos_of_envs[index] = {
                **info_of(infos["final_info"], index),
                "terminal_observation": infos["final_obs"][index],
                "TimeLimit.truncated": bool(truncated[index] and not terminated[index]),
            }
        return observations, rewards, done, infos_of_envs

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_images(self) -> Any:
        """Return a picture per environment."""
        return self.env.render()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute, which all environments share, once per environment."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raise NotImplementedError: one compiled program steps all environments."""
        raise NotImplementedError(f"set_attr({attr_name!r}): all environments share one program")

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        """Raise NotImplementedError: one compiled program steps all environments."""
        raise NotImplementedError(
            f"env_method({method_name!r}): all environments share one program"
        )

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return that no environment has a wrapper of its own."""
        return [False for _ in self._get_indices(indices)]


def info_of(infos: dict[str, Any], index: int) -> dict[str, Any]:
    """Return one environment's part of the infos of a Gymnasium vector environment."""
    return {
        name: values[index]
        for name, values in infos.items()
        if not name.startswith("_") and infos[f"_{name}"][index]
    }
