"""Train with many settings by Ray Tune: ``flytrack sweep settings.toml`` (docs/scaling.md).

Each trial is a training with a folder and an MLflow run of its own, below that of the sweep. ASHA
ends those that fall behind; one that is interrupted continues from its newest checkpoint.
"""

import dataclasses
import socket
import sys
import warnings
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import tyro

from baselines.purejaxrl_ppo.checkpoint import checkpoints_in, newest_intact
from baselines.purejaxrl_ppo.config import (
    OPTIONAL,
    Config,
    ConfigError,
    OptionalPath,
    read_config,
)
from baselines.purejaxrl_ppo.tracking import LOCAL, Tracker, end_unfinished, local_uri
from baselines.purejaxrl_ppo.training import Options, Trainer, track_reference
from flytrack_env.extras import check_installed
from flytrack_env.files import write_atomically
from flytrack_env.jobs import connected
from flytrack_env.messages import error_text, quote_name, quote_value
from flytrack_env.progress import progress_bar
from flytrack_env.toml_file import TomlError, parse_toml, read_text
from flytrack_env.validation import Positive

METRIC = "last_return"  # dense from the start, where success is 0 for long
LISTS = ("choice", "grid_search")  # of values; the others are ranges of numbers
KINDS = (*LISTS, "uniform", "quniform", "loguniform", "qloguniform", "randint", "lograndint")
GRACE, KEPT = 8, 3  # ASHA: no trial ends before 1/8 of its length; of three, the best goes on
CHECKPOINTS = 8  # of a trial
MAX_FAILURES = 8  # of a trial, whose node or process is lost
TABLE, TUNE, RUNGS = "sweep.csv", "tune", "asha.pkl"
Space = dict[str, tuple[str, list[Any]]]


@dataclasses.dataclass(frozen=True)
class Flags:
    """What is swept, and where."""

    settings: Annotated[Path, tyro.conf.Positional]
    """TOML file of hyperparameters, as --config of `flytrack train` takes it, but that a setting
    may be drawn: [learning_rate] with loguniform = [1e-3, 1e-2]."""
    trials: int = 16
    """Draws; with a grid, of each of its points."""
    out: Path = Path("runs/sweep")
    """Folder, which all nodes of a cluster see."""
    resume: bool = False
    """Go on with the sweep in OUT: trials that ended stay, others continue."""
    seed: int = 0
    """Seed of the draws and of every training."""
    env_id: str = "FlyTrack-v0"
    """Id of the environment."""
    track: str = "flytrack"
    """Name of a track, or path of its file."""
    model: OptionalPath = None
    """Model file; by default the nominal model."""
    address: Annotated[
        str | None, tyro.conf.arg(metavar="HOST:PORT|auto", help_behavior_hint=OPTIONAL)
    ] = None
    """A Ray cluster; by default this machine."""
    cpus_per_trial: Positive = 1.0
    """Cores of a trial."""
    gpus_per_trial: float = 0.0
    """GPUs of a trial; 0.25: four trials share one."""
    tracking_uri: str = LOCAL
    """MLflow store; local: an SQLite file in OUT. Empty: none."""


class Base(NamedTuple):
    """What the trials share; each replaces in ``config`` what the space draws."""

    out: Path
    config: Config
    seed: int
    env_id: str
    env_arguments: dict[str, Any]
    options: Options


def read_settings(path: Path) -> tuple[Config, Space]:
    """Return fixed hyperparameters, and how others are drawn: kind and values by name.

    Raises:
        ConfigError: a file, setting, kind or value that cannot be used.
    """
    try:
        content = parse_toml(read_text(path))
    except (OSError, UnicodeDecodeError, TomlError) as error:
        raise ConfigError(f"{path}: cannot be read: {error_text(error)}") from error
    space: Space = {}
    for name, entry in content.items():
        if not isinstance(entry, dict):
            continue
        where = f"{path}: {quote_name(name)}"
        if len(entry) != 1 or next(iter(entry)) not in KINDS:
            found, kinds = quote_value(entry), ", ".join(KINDS)
            raise ConfigError(f"{where}: found {found}, expected one of {kinds}")
        ((kind, values),) = entry.items()
        space[name] = kind, read_draw(path, name, kind, values)
    if not space:
        raise ConfigError(f"{path}: found no setting that is drawn, expected one, as a table")
    fixed = {name: value for name, value in content.items() if name not in space}
    return read_config(str(path), fixed), space


def read_draw(path: Path, name: str, kind: str, values: Any) -> list[Any]:
    """Return the values of a draw; raises ConfigError where the setting cannot have them."""

    def checked(value: Any) -> Any:
        return getattr(read_config(str(path), {name: value}), name)

    where = f"{path}: {quote_name(name)}: {kind}: found {quote_value(values)}"
    if kind in LISTS:
        if not isinstance(values, list) or not values:
            raise ConfigError(f"{where}, expected a list of values")
        return [checked(value) for value in values]
    has_step, is_whole = kind.startswith("q"), kind.endswith("randint")
    is_range = isinstance(values, list) and len(values) == 2 + has_step
    if not is_range or not all(type(one) in (int, float) for one in values):
        step = ", and a step" * has_step
        raise ConfigError(f"{where}, expected lowest and highest value{step}, as numbers")
    low, high = checked(values[0]), checked(values[1] - is_whole)  # randint leaves the highest out
    if (type(low) is int) != is_whole:
        expected = "uniform or the like" if is_whole else "randint or lograndint"
        raise ConfigError(f"{where}, expected {expected} for this setting")
    if values[0] >= values[1] or ("log" in kind and low <= 0) or (has_step and values[2] <= 0):
        raise ConfigError(f"{where}, expected lowest < highest, above 0 for logs and steps")
    return [low, high + is_whole, *values[2:]]


def draws_of(space: Space) -> dict[str, Any]:
    """Return a space in Ray Tune's terms; raises ConfigError for numbers that it refuses."""
    from ray import tune

    draws = {}
    for name, (kind, values) in space.items():
        try:
            draws[name] = getattr(tune, kind)(*([values] if kind in LISTS else values))
        except (TypeError, ValueError, AssertionError) as error:
            found = quote_value(values)
            raise ConfigError(f"{name}: {kind}: found {found}: {error_text(error)}") from error
    return draws


def check_is_shared(out: Path) -> None:
    """Raise ConfigError on a node that does not see the folder of a sweep, which has begun."""
    if not (out / TUNE).is_dir():
        node = socket.gethostname()
        raise ConfigError(
            f"--out {out}: found none on node {node}, expected one that all nodes see"
        )


def run_trial(drawn: dict[str, Any], base: Base) -> None:
    """Train with drawn settings, and tell Ray Tune how well; continue what is in the folder.

    Raises:
        ConfigError: on a node that does not see the sweep's folder.
    """
    from ray import tune

    check_is_shared(base.out)
    out = base.out / Path(tune.get_context().get_trial_dir()).name
    trainer = Trainer(dataclasses.replace(base.config, **drawn), base.env_id, **base.env_arguments)
    start = newest_intact(out) if checkpoints_in(out) else None

    def report(steps: int, values: dict[str, float]) -> None:
        tune.report({"steps": steps, **values})

    trainer.train(out, base.seed, base.options, start, report)


def prepare(flags: Flags) -> tuple[Base, Space]:
    """Return what the trials share, and the space, checked; nothing is written.

    Raises:
        ValueError: settings that no trial could use.
    """
    if flags.trials < 1:
        raise ConfigError(f"--trials: found {flags.trials}, expected at least 1")
    config, space = read_settings(flags.settings)
    out = flags.out.resolve()
    has_sweep = (out / TUNE).exists()
    if has_sweep != flags.resume:
        found = "a sweep" if has_sweep else "none"
        hint = "--resume goes on with it" if has_sweep else "leave --resume out"
        raise ConfigError(f"{out}: found {found}: {hint}")
    model = None if flags.model is None else flags.model.resolve()
    arguments: dict[str, Any] = {"track": track_reference(flags.track), "model": model}
    Trainer(config, flags.env_id, **arguments)
    uri = local_uri(out) if flags.tracking_uri == LOCAL else flags.tracking_uri
    every = max(config.total_timesteps // CHECKPOINTS, 1)
    options = Options(every, config.total_timesteps, tracking_uri=uri)
    return Base(out, config, flags.seed, flags.env_id, arguments, options), space


def make_scheduler(path: Path, config: Config) -> Any:
    """Return ASHA, whose comparisons outlive the process: Ray Tune restores all but its scheduler.

    Args:
        path: file that holds what was compared; a scheduler that is unpickled reads it.
        config: hyperparameters of the trials.
    """
    from ray.tune.schedulers import ASHAScheduler

    class KeptScheduler(ASHAScheduler):
        """ASHA that stores what it compared after each result."""

        def on_trial_result(self, *arguments: Any) -> str:
            action = super().on_trial_result(*arguments)
            self._store()
            return str(action)

        def on_trial_complete(self, *arguments: Any) -> None:
            super().on_trial_complete(*arguments)
            self._store()

        def _store(self) -> None:
            partial = path.with_suffix(".part")
            self.save(str(partial))
            partial.replace(path)

        def __setstate__(self, state: dict[str, Any]) -> None:
            self.__dict__.update(state)
            if path.exists():
                self.restore(str(path))

    length = config.total_timesteps
    return KeptScheduler(
        "steps",
        METRIC,
        "max",
        max_t=length + 1,
        grace_period=max(length // GRACE, config.batch_size),
        reduction_factor=KEPT,
    )


def make_tuner(flags: Flags, base: Base, space: Space) -> Any:
    """Return Ray's tuner of a sweep, or of one that goes on."""
    from ray import tune

    class Progress(tune.Callback):
        """Shows how many trials ended, on one line."""

        bar: Any = None

        def on_trial_complete(self, iteration: int, trials: Any, trial: Any, **info: Any) -> None:
            if self.bar is None:
                self.bar = progress_bar("trials")
            self.bar.update(1)

        def on_experiment_end(self, trials: Any, **info: Any) -> None:
            if self.bar is not None:
                self.bar.close()

        def __getstate__(self) -> dict[str, Any]:
            return {}  # Ray stores callbacks, and a bar cannot be

    resources = {"cpu": flags.cpus_per_trial, "gpu": flags.gpus_per_trial}
    trainable = tune.with_resources(tune.with_parameters(run_trial, base=base), resources)
    if flags.resume:
        return tune.Tuner.restore(
            str(base.out / TUNE),
            trainable,
            resume_unfinished=True,
            resume_errored=True,
            param_space=draws_of(space),
        )
    return tune.Tuner(
        trainable,
        param_space=draws_of(space),
        tune_config=tune.TuneConfig(
            num_samples=flags.trials,
            scheduler=make_scheduler(base.out / TUNE / RUNGS, base.config),
            search_alg=tune.search.BasicVariantGenerator(random_state=flags.seed),
            trial_dirname_creator=lambda trial: (
                f"trial{int(trial.trial_id.rsplit('_', 1)[-1]):03d}"
            ),
        ),
        run_config=tune.RunConfig(
            name=TUNE,
            storage_path=str(base.out),
            verbose=0,
            callbacks=[Progress()],
            failure_config=tune.FailureConfig(max_failures=MAX_FAILURES),
        ),
    )


def run_sweep(flags: Flags) -> int:
    """Run the sweep as an MLflow run; write and print its table; return 1 if every trial failed."""
    check_installed("cluster", "sweeps", "ray")
    base, space = prepare(flags)
    tracker = Tracker(
        base.out,
        base.options.tracking_uri,
        f"sweep {flags.settings.stem}",
        {"space": {name: list(how) for name, how in space.items()}, "trials": flags.trials},
    )
    options = msgspec.structs.replace(base.options, parent_run=tracker.run_id)
    base = base._replace(options=options)
    status = "FAILED"
    try:
        with warnings.catch_warnings(), connected(flags.address or "local"):
            warnings.simplefilter("ignore")  # Ray's, of forks and of its own deprecations
            results = make_tuner(flags, base, space).fit()
        status = "FINISHED"
    finally:
        tracker.end(status)
    table = results.get_dataframe()
    path = base.out / TABLE
    write_atomically(path, table.to_csv(index=False).encode())
    shown = [one for one in table if one in (METRIC, "steps") or one.startswith("config/")]
    shown += [one for one in ("evaluation_success", "evaluation_best_lap_s") if one in table]
    if METRIC in table:
        print(table.sort_values(METRIC, ascending=False)[shown].to_string(index=False))
        print(f"best: {base.out / Path(results.get_best_result(METRIC, 'max').path).name}")
    print(f"written: {path}")
    errors = [result.error for result in results if result.error is not None]
    # Ray's error holds that of the trial beside its traceback.
    for reason in sorted({error_text(getattr(error, "cause", error)) for error in errors}):
        print(f"trials failed: {reason}", file=sys.stderr)
    for folder in base.out.glob("trial*"):  # those that ASHA ended
        end_unfinished(folder, base.options.tracking_uri)
    return int(results.num_errors == len(results))
