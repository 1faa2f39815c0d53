"""Every hyperparameter of a training run, from the command line, a TOML file or a checkpoint."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import tyro
from msgspec import Meta

from flytrack_env.messages import error_text, quote_name
from flytrack_env.toml_file import TomlError, parse_toml, read_text
from flytrack_env.validation import MAX_NUMBER, Finite, Positive, convert

MAX_COUNT, MAX_STEPS = 2**31 - 1, 2**62  # JAX counts with 32 bits; steps are counted in Python
MAX_WIDTH, MAX_LAYERS = 2**16, 16  # a network of thousands of layers takes minutes to build


class ConfigError(ValueError):
    """A setting that cannot be used; the message names file, field, what was found and expected."""


def parse_count(text: str) -> int:
    """Return an integer that may be written as 2e7; raises ValueError for another number."""
    value = float(text)
    if not value.is_integer():
        raise ValueError(f"found {text}, expected a whole number")
    return int(value)


Count = Annotated[
    int,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT",
        instance_from_str=lambda words: parse_count(words[0]),
        is_instance=lambda value: isinstance(value, int),
        str_from_instance=lambda value: [str(value)],
    ),
]
PositiveInt = Annotated[int, Meta(ge=1, le=MAX_COUNT)]
Width = Annotated[int, Meta(ge=1, le=MAX_WIDTH)]
NonNegativeFloat = Annotated[float, Meta(ge=0, le=MAX_NUMBER)]
Fraction = Annotated[float, Meta(ge=0, le=1)]


# What --help shows of flags that may be left out; tyro's own would be {None}|PATH and (default:
# None).
OPTIONAL = "(optional)"
OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint=OPTIONAL)]
OptionalInt = Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint=OPTIONAL)]
OptionalName = Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint=OPTIONAL)]


@dataclasses.dataclass(frozen=True)
class Config:
    """Hyperparameters of PPO; the defaults are the recipe for FlyTrack-v0 (report.md)."""

    total_timesteps: Annotated[Count, Meta(ge=1, le=MAX_STEPS)] = 20_000_000
    """Environment steps over all environments; rounded down to whole updates."""
    num_envs: PositiveInt = 512
    """Environments stepped side by side."""
    num_steps: PositiveInt = 64
    """Steps of every environment per update."""
    episode_steps: PositiveInt = 200
    """Time limit of training episodes, in environment steps. Long ones spend most experience on the
    one line that the policy flies already, and a policy that knows nothing beside it fails on
    another plant."""
    gate_margin: NonNegativeFloat = 0.15
    """Metres by which the drone is thicker, to every side, in training than in the race. A policy
    that uses the whole opening is perfect in the simulator and crashes where the plant differs a
    little."""
    update_epochs: PositiveInt = 1
    """Passes over the collected batch per update. Training spends nearly all of its time on
    gradients, so that one pass in many small steps gets further in a second than several in larger
    ones."""
    num_minibatches: PositiveInt = 64
    """Gradient steps per pass."""
    learning_rate: Positive = 3e-3
    """Adam's step size at the start."""
    final_learning_rate_fraction: Fraction = 0.02
    """The step size falls linearly to this fraction of it at the end."""
    adam_eps: Positive = 1e-5
    """Added to the root in Adam's denominator."""
    gamma: Fraction = 0.99
    """Discount per step."""
    gae_lambda: Fraction = 0.95
    """Decay of the advantage estimator."""
    clip_eps: Positive = 0.2
    """Clipping range of the probability ratio and of the value change."""
    entropy_coef: NonNegativeFloat = 0.0
    """Weight of the entropy bonus."""
    value_coef: NonNegativeFloat = 0.5
    """Weight of the value loss."""
    max_grad_norm: Positive = 1.0
    """Global norm to which gradients are clipped."""
    hidden_sizes: Annotated[tuple[Width, ...], Meta(min_length=1, max_length=MAX_LAYERS)] = (64, 64)
    """Widths of the hidden layers, tanh, of actor and critic each."""
    memory_size: Annotated[int, Meta(ge=0, le=MAX_WIDTH)] = 0
    """Width of a gated recurrent unit whose memory of the episode the layers see beside the
    observation; 0: none. A policy that remembers can adapt to the drone that it flies."""
    encoder_sizes: Annotated[tuple[Width, ...], Meta(max_length=MAX_LAYERS)] = ()
    """Widths of tanh layers between the observation and that unit: what a camera shows is a product
    of distances and angles, which a unit alone does not take apart."""
    critic_sees_state: bool = False
    """Whether the critic sees FlyTrack-v0's observation of the true state beside the policy's. A
    policy that has a camera only cannot know its position at once, but the critic, which is needed
    in training only, need not guess it."""
    state_coef: NonNegativeFloat = 0.0
    """Weight of the mean squared error of the state that a linear layer reads from what the policy
    knows; 0: no such layer. Needs critic_sees_state. The error teaches the memory to hold position,
    velocity and attitude long before rewards would."""
    initial_std: Positive = 0.5
    """Initial standard deviation of the actions, independent of the state. PureJaxRL: 1."""
    min_std: NonNegativeFloat = 0.05
    """Floor of that standard deviation. PureJaxRL: 0, no floor."""
    initial_action: tuple[Finite, ...] = (0.0, 0.0, 0.0, -0.2)
    """Mean action of the untrained policy: sticks centred, thrust about that of hovering.
    PureJaxRL: zeros. Its length is the number of actions; unused where actions are discrete."""
    bootstrap_at_truncation: bool = True
    """Add the final observation's value where the time limit ends an episode. PureJaxRL: no."""
    batched_step: bool = True
    """Step the environments as a batch where they offer it, not under vmap. PureJaxRL: no."""
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

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON values; numbers of NumPy become Python's."""

        def as_builtin(value: Any) -> Any:
            return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else repr(value)

        values: dict[str, Any] = msgspec.to_builtins(self, enc_hook=as_builtin)
        return values

    def check(self) -> "Config":
        """Return the settings in Python's own numbers.

        Raises:
            ConfigError: settings that cannot be trained with; the message names the field.
        """
        config = read_config("", self.as_json())
        if config.num_updates < 1:
            raise ConfigError(
                f"total_timesteps: found {config.total_timesteps}, expected at least one update of "
                f"{config.batch_size} steps (num_envs x num_steps)"
            )
        if config.state_coef and not config.critic_sees_state:
            raise ConfigError(
                f"state_coef: found {config.state_coef}, expected 0 without critic_sees_state"
            )
        is_by_env = config.memory_size > 0
        rows, what = (
            (config.num_envs, "environments") if is_by_env else (config.batch_size, "steps")
        )
        if rows % config.num_minibatches:
            raise ConfigError(
                f"num_minibatches: found {config.num_minibatches}, expected a divisor of "
                f"the {rows} {what} of an update"
            )
        return config


# Hyperparameters by device. A GPU takes about as long for many environments and large minibatches
# as for few and small ones: 9.1 M steps/s, beside 2.4 M with those for a CPU (docs/results/gpu.md).
RECIPES = {"cpu": Config(), "gpu": Config(num_envs=4096, num_steps=16, num_minibatches=32)}


def read_config(where: str, values: Any) -> Config:
    """Read a configuration from a TOML or JSON object; fields that it lacks have their defaults.

    Raises: ConfigError: not an object, an unknown field, or a value of another type or out of its
        range.
    """
    names = [field.name for field in dataclasses.fields(Config)]
    for name in values if isinstance(values, dict) else ():
        if name not in names:
            raise ConfigError(
                f"{where}: {quote_name(name)}: unknown; expected one of {', '.join(names)}"
            )
    return convert(where, values, Config, ConfigError)


def read_config_file(path: Path, defaults: Config = Config()) -> Config:
    """Read a configuration from a TOML file; fields that it lacks are those of ``defaults``.

    Raises:
        ConfigError: a file that cannot be read, or as ``read_config``.
    """
    try:
        values = parse_toml(read_text(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error_text(error)}") from error
    except TomlError as error:
        raise ConfigError(f"{path}: not a TOML file: {error_text(error)}") from error
    return read_config(str(path), defaults.as_json() | values)
