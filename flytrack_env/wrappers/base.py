"""The base of wrappers: an environment around an environment, inside auto-reset.

gymnax's own wrappers go around a step that has already reset itself, so that their state leaks into
the next episode. Ours change the hooks of ``flytrack_env.episodes.EpisodicEnvironment`` instead:
each has one state of its own around the inner state, created when an episode begins. They compose
in any order that makes sense; any other is refused.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from flytrack_env.dynamics import ModelParameters
from flytrack_env.effects import Range
from flytrack_env.episodes import EpisodicEnvironment
from flytrack_env.observations import Entry
from flytrack_env.params import EnvParams
from flytrack_env.race import Race
from flytrack_env.state import Action, Drone


class WrapperError(ValueError):
    """An order of wrappers that makes no sense; the message says why."""


class InnerState(NamedTuple):
    """The state of a wrapper that remembers nothing."""

    inner: Any


class Wrapper(EpisodicEnvironment):
    """Delegates every hook; a wrapper overrides those that it changes.

    Its state is a NamedTuple whose field ``inner`` holds the wrapped environment's state.

    Attributes:
        key: its name, and that of its parameters in ``EnvParams.wrappers``; no two wrappers of an
            environment share one.
        needs_rows: whether it adds to rows of the observation, so that no image may be inside.

    Raises:
        WrapperError: anything but FlyTrack or a wrapper of ours, the same wrapper twice, or one
            that this wrapper refuses.
    """

    key: str
    needs_rows = False

    def __init__(self, env: EpisodicEnvironment):
        super().__init__()
        name = type(self).__name__
        if not isinstance(env, EpisodicEnvironment):
            raise WrapperError(
                f"{name}: found {type(env).__name__} inside, "
                "expected FlyTrack or a wrapper that acts before auto-reset; "
                "wrappers of another step (LegacyStep, gymnax's) go outermost"
            )
        for inside in layers_of(env):
            reason = self.refusal(inside)
            if reason is not None:
                raise WrapperError(f"{name} around {type(inside).__name__}: {reason}")
        self._transition_gradients_enabled = env.transition_gradients_enabled
        self.env = env
        self.track, self.plant, self.missed_gate = env.track, env.plant, env.missed_gate
        self.image_shape = env.image_shape
        self.env_id = f"{name}({env.env_id})"

    def refusal(self, inside: EpisodicEnvironment) -> str | None:
        """Return why this wrapper may not go around an inner one, however deep; None if it may."""
        if isinstance(inside, Wrapper) and inside.key == self.key:
            return f"both have the name {self.key!r}, which identifies their parameters and draws"
        if self.needs_rows and inside.image_shape is not None:
            return "an image has no rows that it could change or add to"
        return None

    def own_defaults(self) -> Any:
        """Return the default parameters of this wrapper, a NamedTuple; None if it has none."""
        return None

    def own_params(self, params: EnvParams) -> Any:
        """Return this wrapper's part of the parameters.

        Raises:
            ValueError: parameters of an environment without this wrapper.
        """
        if self.key not in params.wrappers:
            found = sorted(params.wrappers)
            raise ValueError(f"params.wrappers: found {found}, expected {self.key!r} among them")
        return params.wrappers[self.key]

    @property
    def default_params(self) -> EnvParams:  # type: ignore[override]  # of gymnax: see EpisodicEnvironment
        """The inner environment's, with this wrapper's own."""
        params = self.env.default_params
        defaults = self.own_defaults()
        return (
            params
            if defaults is None
            else params.replace(wrappers={**params.wrappers, self.key: defaults})
        )

    @property
    def observation_table(self) -> tuple[Entry, ...]:
        """The inner environment's."""
        return self.env.observation_table

    def drone(self, state: Any) -> Drone:
        """Return the drone of a state, as it is."""
        return self.env.drone(state.inner)

    def race(self, state: Any) -> Race:
        """Return where the drone stands in the race."""
        return self.env.race(state.inner)

    def model(self, state: Any, params: EnvParams) -> ModelParameters:
        """Return the model that a state's episode is flown with."""
        return self.env.model(state.inner, params)

    def sample_start(self, seed: jax.Array, params: EnvParams) -> tuple[Drone, jax.Array]:
        """Return a drone that begins an episode, and the gate to fly first."""
        return self.env.sample_start(seed, params)

    def begin(self, drone: Drone, gate_index: Any, params: EnvParams, seed: Any = 0) -> Any:
        """Return the state of an episode that begins."""
        return InnerState(self.env.begin(drone, gate_index, params, seed))

    def advance(
        self, state: Any, command: Action, params: EnvParams
    ) -> tuple[Any, jax.Array, jax.Array, dict[str, Any]]:
        """Return the outcome of the inner environment."""
        inner, reward, terminated, info = self.env.advance(state.inner, command, params)
        return InnerState(inner), reward, terminated, info

    def observe_drone(self, drone: Drone, state: Any, params: EnvParams) -> list[jax.Array]:
        """Return the inner environment's observation."""
        return self.env.observe_drone(drone, state.inner, params)

    def compose(self, rows: list[jax.Array], params: EnvParams) -> jax.Array:
        """Return the inner environment's observation of its rows."""
        return self.env.compose(rows, params)

    def is_truncated(self, state: Any, params: EnvParams) -> jax.Array:
        """Return whether the time limit is reached."""
        return self.env.is_truncated(state.inner, params)

    def check_params(self, params: EnvParams) -> None:
        """Raise ValueError for parameters that cannot be flown, or that lack this wrapper's own."""
        self.env.check_params(params)
        defaults = self.own_defaults()
        if defaults is None:
            return
        found = params.wrappers.get(self.key)
        if jax.tree.structure(found) != jax.tree.structure(defaults):  # type: ignore[operator]  # jaxlib's stub has no !=
            raise ValueError(
                f"params.wrappers[{self.key!r}]: found {found!r}, "
                f"expected {type(defaults).__name__}, as in this environment's default_params"
            )

    def check_ranges(self, params: EnvParams, ranges: Mapping[str, Range]) -> None:
        """Raise ValueError, naming the field, unless each own parameter is within its range."""
        for name, value in self.own_params(params)._asdict().items():
            low, high, unit = ranges[name]
            if not np.all((np.asarray(value) >= low) & (np.asarray(value) <= high)):
                raise ValueError(
                    f"params.wrappers[{self.key!r}].{name}: found {value}, "
                    f"expected {low:g} to {high:g} {unit}"
                )


def layers_of(env: EpisodicEnvironment) -> list[EpisodicEnvironment]:
    """Return an environment and everything inside it, outermost first."""
    layers = [env]
    while isinstance(layers[-1], Wrapper):
        layers.append(layers[-1].env)
    return layers
