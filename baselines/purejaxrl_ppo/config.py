"""Every hyperparameter of a training run, from the command line, a TOML file or a checkpoint."""

import dataclasses
import math
import sys
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import tyro

from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_env.toml_file import TomlError, parse_toml, read_text

COUNTS = ("num_envs", "num_steps", "episode_steps", "update_epochs", "num_minibatches")
SHARES = ("final_learning_rate_fraction", "gamma", "gae_lambda")
POSITIVE = ("learning_rate", "adam_eps", "clip_eps", "max_grad_norm", "initial_std")
NOT_NEGATIVE = ("entropy_coef", "value_coef", "min_std", "gate_margin", "memory_size")
LARGEST = sys.float_info.max  # integers in a file are unbounded


class ConfigError(ValueError):
    """A setting that cannot be used; the message names file, field, what was found and expected."""


def parse_count(text: str) -> int:
    """Return an integer that may be written as 2e7; raises ValueError for another number."""
    value = float(text)
    if not value.is_integer():
        raise ValueError(f"found {text}, expected a whole number")
    return int(value)


Count = typing.Annotated[
    int,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT",
        instance_from_str=lambda words: parse_count(words[0]),
        is_instance=lambda value: isinstance(value, int),
        str_from_instance=lambda value: [str(value)],
    ),
]


# What --help shows of flags that may be left out; tyro's own would be {None}|PATH and (default: None).
OPTIONAL = "(optional)"
OptionalPath = typing.Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint=OPTIONAL)]
OptionalInt = typing.Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint=OPTIONAL)]
OptionalName = typing.Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint=OPTIONAL)]


@dataclasses.dataclass(frozen=True)
class Config:
    """Hyperparameters of PPO; the defaults are the recipe for FlyTrack-v0 (report.md)."""

    total_timesteps: Count = 20_000_000
    """Environment steps over all environments; rounded down to whole updates."""
    num_envs: int = 512
    """Environments stepped side by side."""
    num_steps: int = 64
    """Steps of every environment per update."""
    episode_steps: int = 200
    """Time limit of training episodes, in environment steps. Long ones spend most experience on the one
    line that the policy flies already, and a policy that knows nothing beside it fails on another plant."""
    gate_margin: float = 0.15
    """Metres by which the drone is thicker, to every side, in training than in the race. A policy that
    uses the whole opening is perfect in the simulator and crashes where the plant differs a little."""
    update_epochs: int = 1
    """Passes over the collected batch per update. Gradients are nearly all of the time that training takes,
    so that one pass in many small steps gets further in a second than several in larger ones."""
    num_minibatches: int = 64
    """Gradient steps per pass."""
    learning_rate: float = 3e-3
    """Adam's step size at the start."""
    final_learning_rate_fraction: float = 0.02
    """The step size falls linearly to this fraction of it at the end."""
    adam_eps: float = 1e-5
    """Added to the root in Adam's denominator."""
    gamma: float = 0.99
    """Discount per step."""
    gae_lambda: float = 0.95
    """Decay of the advantage estimator."""
    clip_eps: float = 0.2
    """Clipping range of the probability ratio and of the value change."""
    entropy_coef: float = 0.0
    """Weight of the entropy bonus."""
    value_coef: float = 0.5
    """Weight of the value loss."""
    max_grad_norm: float = 1.0
    """Global norm to which gradients are clipped."""
    hidden_sizes: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers, tanh, of actor and critic each."""
    memory_size: int = 0
    """Width of a gated recurrent unit whose memory of the episode the layers see beside the observation; 0:
    none. A policy that remembers can adapt to the drone that it flies."""
    initial_std: float = 0.5
    """Standard deviation of the actions at the start; it does not depend on the state. PureJaxRL: 1."""
    min_std: float = 0.05
    """Floor of that standard deviation. PureJaxRL: 0, no floor."""
    initial_action: tuple[float, ...] = (0.0, 0.0, 0.0, -0.2)
    """Mean action of the untrained policy: sticks centred, thrust about that of hovering. PureJaxRL: zeros.
    Its length is the number of actions; unused where actions are discrete."""
    bootstrap_at_truncation: bool = True
    """Add the value of the final observation where the time limit cuts an episode off. PureJaxRL: no."""
    batched_step: bool = True
    """Step the environments as a batch where they offer it, not one by one under vmap. PureJaxRL: no."""
    affine_shuffle: bool = True
    """Draw minibatches with an affine permutation, not with one from a sort. PureJaxRL: no."""
    anneal_every_gradient: bool = True
    """Lower the step size at every gradient step, not once per update. PureJaxRL: no."""

    @property
    def batch_size(self) -> int:
        """Environment steps per update."""
        return self.num_envs * self.num_steps

    @property
    def num_updates(self) -> int:
        """Number of updates."""
        return self.total_timesteps // self.batch_size

    @property
    def gradients_per_update(self) -> int:
        """Gradient steps per update."""
        return self.update_epochs * self.num_minibatches

    def check(self) -> None:
        """Raise ConfigError, naming the field, for settings that cannot be trained with."""
        self._check_range(COUNTS, lambda value: value >= 1, "at least 1")
        self._check_range(SHARES, lambda value: 0 <= value <= 1, "0 to 1")
        self._check_range(POSITIVE, lambda value: 0 < value < math.inf, "a positive number")
        self._check_range(NOT_NEGATIVE, lambda value: 0 <= value < math.inf, "a number that is not negative")
        if not self.hidden_sizes or min(self.hidden_sizes) < 1:
            raise ConfigError(f"hidden_sizes: found {self.hidden_sizes}, expected widths of at least 1")
        if self.num_updates < 1:
            raise ConfigError(
                f"total_timesteps: found {self.total_timesteps}, expected at least one update of "
                f"{self.batch_size} steps (num_envs x num_steps)"
            )
        rows, what = (self.num_envs, "environments") if self.memory_size else (self.batch_size, "steps")
        if rows % self.num_minibatches:
            raise ConfigError(
                f"num_minibatches: found {self.num_minibatches}, expected a divisor of the {rows} {what} of "
                "an update"
            )

    def _check_range(self, names: tuple[str, ...], is_valid: Callable[[Any], bool], expected: str) -> None:
        for name in names:
            value = getattr(self, name)
            if not is_valid(value):
                raise ConfigError(f"{name}: found {value}, expected {expected}")


FIELD_TYPES: dict[str, Any] = typing.get_type_hints(Config)


def read_value(where: str, kind: Any, value: Any) -> Any:
    """Return a value of a TOML or JSON file as a field's type; a whole float (2e7) is an integer.

    where: file and field, which the error message begins with.

    Raises:
        ConfigError: a value of another type.
    """
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, (list, tuple)):
            raise ConfigError(f"{where}: found {quote_value(value)}, expected a list")
        return tuple(read_value(where, typing.get_args(kind)[0], one) for one in value)
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= LARGEST
    if kind is bool and isinstance(value, bool):
        return value
    if kind is float and is_number:
        return float(value)
    if kind is int and is_number and value == int(value):
        return int(value)
    expected = {bool: "true or false", float: "a finite number", int: "a whole number"}[kind]
    raise ConfigError(f"{where}: found {quote_value(value)}, expected {expected}")


def read_settings(where: str, values: Any) -> dict[str, Any]:
    """Return the fields of ``Config`` in a TOML or JSON object.

    Raises:
        ConfigError: not an object, an unknown field, or a value of another type.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{where}: found {quote_value(values)}, expected an object")
    for name in values:
        if name not in FIELD_TYPES:
            raise ConfigError(
                f"{where}: {quote_name(name)}: unknown; expected one of {', '.join(FIELD_TYPES)}"
            )
    return {name: read_value(f"{where}: {name}", FIELD_TYPES[name], value) for name, value in values.items()}


def settings_in_file(path: Path) -> dict[str, Any]:
    """Return the fields of ``Config`` that a TOML file sets.

    Raises:
        ConfigError: a file that cannot be read, an unknown key, or a value of another type.
    """
    try:
        return read_settings(str(path), parse_toml(read_text(path)))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error_text(error)}") from error
    except TomlError as error:
        raise ConfigError(f"{path}: not a TOML file: {error_text(error)}") from error
