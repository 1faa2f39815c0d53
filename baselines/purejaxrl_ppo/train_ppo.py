"""Train PPO on a FlyTrack environment: ``flytrack train`` (docs/baseline.md)."""

import dataclasses
import sys
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NoReturn

import tyro

from baselines.purejaxrl_ppo import checkpoint as files
from baselines.purejaxrl_ppo.checkpoint import FINAL, Checkpoint, CheckpointError
from baselines.purejaxrl_ppo.config import Config, OptionalInt, OptionalPath, settings_in_file
from baselines.purejaxrl_ppo.tracking import has_moved, local_uri
from baselines.purejaxrl_ppo.training import Options, Run, Task, Trainer
from flytrack_env.messages import error_text
from flytrack_env.model_file import model_from_json

PROG = "flytrack train"
MAX_SEED = 2**31
INTERRUPTED = 130  # what shells return for a command that Ctrl-C ended
DEFAULT_OUT = Path("runs/train")
LOCAL = "local"  # tracking URI
DEFAULTS = Options(checkpoint_every=1_000_000, evaluate_every=4_000_000, tracking_uri=LOCAL)


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

    config: OptionalPath = None
    """TOML file of hyperparameters; flags override it."""
    resume: OptionalPath = None
    """Continue from a checkpoint, from a folder's newest intact one, or with all seeds in a folder of
    seed<N>. What is not given is as it was."""


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
    """First seed."""
    num_seeds: int = 1
    """Train so many seeds, each in OUT/seed<N>."""
    seeds_at_once: OptionalInt = None
    """So many of them side by side in one program; by default all. On a CPU, 1 is fastest."""
    out: OptionalPath = None
    """Folder; by default runs/train, or that of --resume."""
    no_tracking: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Do not use MLflow."""
    run: Options = DEFAULTS
    """What is done beside training."""
    hyperparameters: Config = Config()  # noqa: RUF009, frozen
    """Of PPO."""

    def check(self) -> None:
        """Raise ValueError, naming the flag, for numbers out of range."""
        for name in ("num_seeds", "seeds_at_once"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"--{name.replace('_', '-')}: found {value}, expected at least 1")
        if not 0 <= self.seed <= MAX_SEED - self.num_seeds:
            raise ValueError(f"--seed: found {self.seed}, expected 0 to {MAX_SEED - self.num_seeds}")


class Resumed(NamedTuple):
    """What ``--resume`` found: the folder, and per seed where it continues (None: it has not begun)."""

    folder: Path
    starts: dict[int, Checkpoint | None]
    is_single: bool

    @property
    def first(self) -> Checkpoint:
        """The first checkpoint found."""
        return next(start for start in self.starts.values() if start is not None)


Plan = tuple[Trainer, list[list[Run]]]  # the runs that train side by side together


def find_starts(resume: Path) -> Resumed:
    """Return what there is to resume in a file or folder; raises CheckpointError if nothing is."""
    seeds = files.seeds_in(resume)
    if not seeds or files.checkpoints_in(resume):
        start = files.newest_intact(resume)
        folder = resume if resume.is_dir() else resume.parent
        return Resumed(folder, {start.meta["seed"]: start}, is_single=True)
    found = {seed: files.newest_intact(resume / f"seed{seed}") for seed in seeds}
    seeds = sorted({*seeds, *saved_options(next(iter(found.values()))).seeds})
    return Resumed(resume, {seed: found.get(seed) for seed in seeds}, is_single=False)


def saved_options(start: Checkpoint) -> Options:
    """Return the options that a checkpoint was written with; raises CheckpointError if they are none."""
    try:
        found = start.meta["options"].items()
        values = {name: value for name, value in found if value is not None}
        values["tracking_uri"] = str(values.get("tracking_uri", ""))
        options = Options(**{**values, "seeds": tuple(map(int, values["seeds"]))})
        options.check()
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{start.path}: options: {error_text(error)}") from error
    return options


def defaults_of(resumed: Resumed) -> Settings:
    """Return the settings of the run that is resumed, which flags override."""
    start, options = resumed.first, saved_options(resumed.first)
    uri = LOCAL if has_moved(options.tracking_uri) else options.tracking_uri
    return Settings(
        env_id=start.env_id,
        track=start.track,
        seed=min(resumed.starts),
        num_seeds=len(resumed.starts),
        seeds_at_once=files.seeds_side_by_side(start),
        run=options._replace(tracking_uri=uri),
        hyperparameters=start.config,
    )


def parse(words: Sequence[str]) -> tuple[Settings, Resumed | None]:
    """Return the settings of a command line, and what it resumes."""
    sources, _ = tyro.cli(Sources, args=words, prog=PROG, add_help=False, return_unknown_args=True)
    resumed = None if sources.resume is None else find_starts(sources.resume)
    defaults = Settings() if resumed is None else defaults_of(resumed)
    if sources.config is not None:
        config = dataclasses.replace(defaults.hyperparameters, **settings_in_file(sources.config))
        defaults = dataclasses.replace(defaults, hyperparameters=config)
    settings = tyro.cli(
        Settings, args=words, prog=PROG, default=defaults, config=(tyro.conf.OmitArgPrefixes,)
    )
    settings.check()
    return settings, resumed


def make_tasks(settings: Settings, resumed: Resumed | None) -> list[list[Task]]:
    """Return a task per seed, those that train side by side together.

    Raises:
        ValueError: other seeds than those of a folder that is resumed.
    """
    seeds = list(range(settings.seed, settings.seed + settings.num_seeds))
    starts: list[Checkpoint | None] = [None] * len(seeds)
    is_single = len(seeds) == 1
    if resumed is not None:
        is_single, known, starts = resumed.is_single, list(resumed.starts), list(resumed.starts.values())
        if not is_single and seeds[0] == known[0] and len(seeds) == len(known):
            seeds = known
        elif not is_single or len(seeds) > 1:
            found = f"seeds {seeds}, but {resumed.folder} holds {known}"
            raise ValueError(f"--resume: found {found}; leave out --seed and --num-seeds")
    out = settings.out or (DEFAULT_OUT if resumed is None else resumed.folder)
    uri = local_uri(out) if settings.run.tracking_uri == LOCAL else settings.run.tracking_uri
    options = settings.run._replace(
        tracking_uri="" if settings.no_tracking else uri, resume=None, seeds=tuple(seeds)
    )
    at_once = settings.seeds_at_once or len(seeds)
    groups = []
    for first in range(0, len(seeds), at_once):
        own = slice(first, first + at_once)
        pairs = zip(seeds[own], files.at_common_step(starts[own]), strict=True)
        groups.append(
            [Task(out if is_single else out / f"seed{seed}", seed, options, start) for seed, start in pairs]
        )
    return groups


def make_trainer(settings: Settings, resumed: Resumed | None) -> Trainer:
    """Return the trainer of a command line; errors name the checkpoint that some settings come from."""
    reward = parse_rewards(settings.reward)
    arguments: dict[str, Any] = {"track": settings.track, "reward": reward, "model": settings.model}
    if resumed is None:
        return Trainer(settings.hyperparameters, settings.env_id, **arguments)
    checkpoint = resumed.first
    try:
        arguments["model"] = settings.model or model_from_json(checkpoint.meta["model"], "model")
        arguments["missed_gate"] = checkpoint.meta["missed_gate"]
        arguments["reward"] = files.rewards_of(checkpoint) | reward
        return Trainer(settings.hyperparameters, settings.env_id, **arguments)
    except (ValueError, OverflowError, OSError) as error:
        text = f"{checkpoint.path}: with its settings and the flags: {error_text(error)}"
        raise CheckpointError(text) from error


def make_plan(words: Sequence[str]) -> Plan:
    """Return the plan of a command line; everything is checked before anything is trained."""
    settings, resumed = parse(words)
    groups = make_tasks(settings, resumed)
    trainer = make_trainer(settings, resumed)
    return trainer, [trainer.prepare(tasks) for tasks in groups]


def run(plan: Plan) -> None:
    """Train every seed; print where it continues from and where its checkpoint is."""
    trainer, groups = plan
    for one in chain(*groups):
        if one.start is not None:
            print(f"seed {one.seed}: from step {one.steps}, {one.start.path}")
    for group in groups:
        for one, (checkpoint, _) in zip(group, trainer.run(group), strict=True):
            meta = checkpoint.meta
            print(f"seed {one.seed}: {meta['steps']} steps in {meta['seconds']} s: {one.out / FINAL}")


def stopped_text(plan: Plan) -> str:
    """Return the message for a training that was stopped."""
    trainer, groups = plan
    folder, *others = (one.out for one in chain(*groups))
    if any(files.checkpoints_in(out) for out in (folder, *others)):
        where = folder.parent if others else folder
        return f"stopped at {trainer.steps} steps; continue with --resume {where}"
    return f"stopped at {trainer.steps} steps, before the first checkpoint"


def leave(status: int, text: str) -> NoReturn:
    """Exit with a message."""
    print(text, file=sys.stderr)
    raise SystemExit(status)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train as the command line says."""
    error = f"{PROG}: error:"
    try:
        plan = make_plan(sys.argv[1:] if arguments is None else arguments)
    except (ValueError, OverflowError, OSError) as found:
        leave(2, f"{error} {found}")
    try:
        run(plan)
    except KeyboardInterrupt:
        leave(INTERRUPTED, stopped_text(plan))
    except (ValueError, OSError) as found:
        leave(1, f"{error} {found}")


if __name__ == "__main__":
    main()
