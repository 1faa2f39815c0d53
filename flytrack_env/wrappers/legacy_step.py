"""A 5-value step for clients written before gymnax 1.0 (PureJaxRL, rejax, the handout)."""

from functools import partial
from typing import Any

import jax

from flytrack_env.env import FlyTrack
from flytrack_env.wrappers.base import WrapperError


class LegacyStep:
    """Wrap an environment so that ``step`` returns obs, state, reward, done, info.

    ``done`` is terminated or truncated; both stay in ``info``, as does ``final_observation``.
    Survives ``copy.deepcopy`` and ``pickle``.

    Raises:
        WrapperError: an environment whose step has five values already.
    """

    def __init__(self, env: Any):
        if isinstance(env, LegacyStep):
            raise WrapperError(
                "LegacyStep around LegacyStep: the step inside has five values already"
            )
        self._env = env

    def __getattr__(self, name: str) -> Any:
        # Copying and unpickling look attributes up before __init__ has set any.
        if name == "_env" or (name.startswith("__") and name.endswith("__")):
            raise AttributeError(name)
        return getattr(self._env, name)

    def with_transition_gradients(self) -> "LegacyStep":
        """Return the same around an environment that lets gradients through, see gymnax."""
        return LegacyStep(self._env.with_transition_gradients())

    @partial(jax.jit, static_argnames=("self",))
    def reset(self, key: jax.Array, params: Any = None) -> tuple[Any, Any]:
        """Return observation and state."""
        return self._env.reset(key, params)

    @partial(jax.jit, static_argnames=("self",))
    def step(
        self, key: jax.Array, state: Any, action: Any, params: Any = None
    ) -> tuple[Any, Any, jax.Array, jax.Array, dict[str, Any]]:
        """Return observation, state, reward, done and info."""
        obs, state, reward, terminated, truncated, info = self._env.step(key, state, action, params)
        return obs, state, reward, terminated | truncated, info


class DroneRaceEnv(LegacyStep):
    """The handout's environment, by its name: ``FlyTrack`` with a step of five values.

    Args:
        arguments: of ``FlyTrack``.
    """

    def __init__(self, **arguments: Any):
        super().__init__(FlyTrack(**arguments))

    # The handout calls the key rng, by which it may be passed.
    def reset(self, rng: jax.Array, params: Any = None) -> tuple[Any, Any]:  # type: ignore[override]
        """Return observation and state."""
        return super().reset(rng, params)

    def step(  # type: ignore[override]
        self, rng: jax.Array, state: Any, action: Any, params: Any = None
    ) -> tuple[Any, Any, jax.Array, jax.Array, dict[str, Any]]:
        """Return observation, state, reward, done and info."""
        return super().step(rng, state, action, params)
