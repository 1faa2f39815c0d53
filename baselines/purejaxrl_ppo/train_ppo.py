"""Train PPO on a FlyTrack environment: ``flytrack train`` (docs/baseline.md)."""

import dataclasses
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import jax
import msgspec
import tyro
from jax.extend.backend import clear_backends
from jax.sharding import Mesh

from baselines.purejaxrl_ppo import devices
from baselines.purejaxrl_ppo.checkpoint import (
    FINAL,
    Checkpoint,
    CheckpointError,
    newest_intact,
    rewards_of,
)
from baselines.purejaxrl_ppo.config import (
    OPTIONAL,
    RECIPES,
    Config,
    OptionalInt,
    OptionalName,
    OptionalPath,
    read_config_file,
)
from baselines.purejaxrl_ppo.training import (
    DEFAULT_OPTIONS,
    DivergedError,
    Options,
    Stopped,
    Trainer,
)
from flytrack_env.messages import error_text
from flytrack_env.model_file import model_from_json

PROG = "flytrack train"
MAX_SEED = 2**31 - 1
DEFAULT_OUT = Path("runs/train")


def parse_rewards(words: Sequence[str]) -> dict[str, float]:
    """Return terms and weights of ``TERM=WEIGHT``; raises ValueError for another form."""
    rewards = {}
    for word in words:
        name, _, weight = word.partition("=")
        try:
            rewards[name] = float(weight)
        except ValueError as error:
            raise ValueError(f"--reward: found {word!r}, expected TERM=WEIGHT") from error
    return rewards


@dataclasses.dataclass(frozen=True)
class Sources:
    """What decides the defaults of all other settings, and is read before them."""

    device: Annotated[
        Literal["cpu", "gpu"] | None,
        tyro.conf.arg(metavar="cpu|gpu", help_behavior_hint=OPTIONAL),
    ] = None
    """Train on it, and with the hyperparameters for it unless --resume has others; by default on
    what JAX prefers, with those for a CPU."""
    devices: Annotated[str | None, tyro.conf.arg(metavar="N|all", help_behavior_hint=OPTIONAL)] = (
        None
    )
    """Number of devices in each process that share the environments. Default: one, or all with
    several processes. On a CPU, N threads are the devices."""
    coordinator: OptionalName = None
    """Train together with other processes that are given the same command: HOST:PORT at which
    process 0 listens, or auto in a job of SLURM, Open MPI or Kubernetes."""
    num_processes: OptionalInt = None
    """Number of processes, unless auto."""
    process: OptionalInt = None
    """Index of this one, from 0, unless auto."""
    config: OptionalPath = None
    """TOML file of hyperparameters; flags override it."""
    resume: OptionalPath = None
    """Continue from a checkpoint, or from a folder's newest intact one. Id, track, model, reward,
    seed and hyperparameters are as they were; a larger --total-timesteps extends the run."""


@dataclasses.dataclass(frozen=True)
class Settings(Sources):
    """Train PPO on a FlyTrack environment; docs/baseline.md describes what it writes."""

    env_id: str = "FlyTrack-v0"
    """Id of the environment."""
    track: str = "flytrack"
    """Name of a track, or path of its file."""
    model: OptionalPath = None
    """Model file; by default the nominal model."""
    reward: tuple[str, ...] = ()
    """Weights of reward terms, TERM=WEIGHT (docs/envs); the others are default."""
    seed: int = 0
    """Seed."""
    out: OptionalPath = None
    """Folder; by default runs/train, or that of --resume."""
    no_tracking: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Do not use MLflow."""
    run: Options = DEFAULT_OPTIONS
    """What is done beside training."""
    hyperparameters: Config = Config()  # noqa: RUF009, frozen
    """Of PPO."""


def choose_device(device: str | None) -> None:
    """Have JAX compute on a device; raises ValueError where there is no such device."""
    if device == "cpu":
        jax.config.update("jax_platforms", "cpu")
    backend = jax.default_backend()
    if device is not None and (backend == "cpu") != (device == "cpu"):
        how = "choose before JAX computes" if device == "cpu" else "pip install 'jax[cuda13]'"
        raise ValueError(f"--device: found JAX on the {backend}, expected {device}: {how}")


def choose_mesh(sources: Sources) -> Mesh | None:
    """Join the other processes, and return the devices that share a training; None: the default.

    Raises:
        ValueError: no such devices, or other processes that cannot be reached.
    """
    count = sources.devices
    if count not in (None, "all") and not (count.isdecimal() and int(count)):
        raise ValueError(f"--devices: found {count!r}, expected a number from 1, or all")
    if sources.coordinator is None and (sources.num_processes or sources.process) is not None:
        raise ValueError("--num-processes and --process: found without --coordinator")
    if count is None and sources.coordinator is None:
        choose_device(sources.device)
        return None
    clear_backends()  # gymnax computes when it is imported; the devices are chosen anew
    number = int(count) if count not in (None, "all") else None
    if number is not None and "host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        jax.config.update("jax_num_cpu_devices", number)  # before JAX computes
    if sources.coordinator is not None:
        devices.join(sources.coordinator, sources.num_processes, sources.process)
    choose_device(sources.device)
    return devices.make_mesh(number)


def parse(words: Sequence[str]) -> tuple[Settings, Checkpoint | None, Mesh | None]:
    """Return the settings of a command line, the checkpoint that it resumes, and its devices."""
    sources, _ = tyro.cli(Sources, args=words, prog=PROG, add_help=False, return_unknown_args=True)
    mesh = choose_mesh(sources)
    defaults, start = Settings(hyperparameters=RECIPES[sources.device or "cpu"]), None
    if sources.resume is not None:
        start = newest_intact(sources.resume)
        defaults = Settings(
            env_id=start.env_id,
            track=start.track,
            seed=start.meta["seed"],
            hyperparameters=start.config,
        )
    if sources.config is not None:
        config = read_config_file(sources.config, defaults.hyperparameters)
        defaults = dataclasses.replace(defaults, hyperparameters=config)
    settings = tyro.cli(
        Settings, args=words, prog=PROG, default=defaults, config=(tyro.conf.OmitArgPrefixes,)
    )
    if not 0 <= settings.seed <= MAX_SEED:
        raise ValueError(f"--seed: found {settings.seed}, expected 0 to {MAX_SEED}")
    return settings, start, mesh


def make_trainer(settings: Settings, start: Checkpoint | None, mesh: Mesh | None = None) -> Trainer:
    """Return the trainer of a command line.

    Errors name the checkpoint from which some settings come.
    """
    reward = parse_rewards(settings.reward)
    arguments: dict[str, Any] = {"track": settings.track, "reward": reward, "model": settings.model}
    arguments["mesh"] = mesh
    if start is None:
        return Trainer(settings.hyperparameters, settings.env_id, **arguments)
    try:
        arguments["model"] = settings.model or model_from_json(start.meta["model"], "model")
        arguments["missed_gate"] = start.meta["missed_gate"]
        arguments["reward"] = rewards_of(start) | reward
        return Trainer(settings.hyperparameters, settings.env_id, **arguments)
    except (ValueError, OverflowError, OSError) as error:
        raise CheckpointError(
            f"{start.path}: with its settings and the flags: {error_text(error)}"
        ) from error


def train(words: Sequence[str]) -> None:
    """Train as a command line says; print where the run continues from, and its checkpoint."""
    settings, start, mesh = parse(words)
    trainer = make_trainer(settings, start, mesh)
    is_first = devices.is_first()
    options, out = settings.run, settings.out or DEFAULT_OUT
    if settings.no_tracking:
        options = msgspec.structs.replace(options, tracking_uri="")
    if start is not None:
        out = settings.out or start.path.parent
    if start is not None and is_first:
        print(f"seed {settings.seed}: from step {start.steps}, {start.path}")
    final, _ = trainer.train(out, settings.seed, options, start)
    if is_first:
        print(
            f"seed {settings.seed}: {final.steps} steps in {final.meta['seconds']} s: {out / FINAL}"
        )


def leave(status: int, text: object) -> NoReturn:
    """Exit with a message."""
    print(text, file=sys.stderr, flush=True)
    devices.leave_alone(status)
    raise SystemExit(status)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train as the command line says.

    Exits with 2 if it is refused, with 1 if it fails, and with 128 + N for a signal N.
    """
    try:
        train(sys.argv[1:] if arguments is None else arguments)
    except Stopped as stopped:
        leave(128 + stopped.signal_number, stopped)
    except KeyboardInterrupt:
        leave(128 + signal.SIGINT, "stopped")
    except (ValueError, OverflowError, OSError) as error:
        leave(1 if isinstance(error, (DivergedError, OSError)) else 2, f"{PROG}: error: {error}")


if __name__ == "__main__":
    main()
