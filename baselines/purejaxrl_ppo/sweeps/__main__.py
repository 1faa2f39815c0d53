"""Trains with many settings: ``python -m baselines.purejaxrl_ppo.sweeps SPACE.toml --trials 16``.

SPACE.toml defines how settings are drawn (docs/scaling.md); all others are flags. Ray Tune runs the trials,
here or, where RAY_ADDRESS names one, on a cluster that sees the same folder. In MLflow every trial is a run
below that of the sweep.
"""

import dataclasses
import logging
import os
import sys
import warnings
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import ray
import tyro
from ray import tune
from ray.tune import ResultGrid

from baselines.purejaxrl_ppo.config import Config, ConfigError, load_toml, settings_in_file
from baselines.purejaxrl_ppo.run import Options
from baselines.purejaxrl_ppo.sweeps.space import read_space
from baselines.purejaxrl_ppo.tracking import Tracker, local_uri
from baselines.purejaxrl_ppo.training import Trainer
from flytrack_env.files import write_atomically

PROG = "sweeps"
METRIC = "evaluation_success"
QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AIR_NEW_OUTPUT": "0"}


@dataclasses.dataclass(frozen=True)
class Settings:
    """Train with many settings by Ray Tune."""

    space: Annotated[Path, tyro.conf.Positional]
    """TOML file of the settings that are drawn."""
    trials: int = 16
    """Draws; with a grid, of every point of it."""
    out: Path = Path("runs/sweep")
    """Folder."""
    seed: int = 0
    """Of the draws and of every training."""
    env_id: str = "FlyTrack-v0"
    """Id of the environment."""
    track: str = "flytrack"
    """Name of a track, or path of its file."""
    model: Path | None = None
    """Model file; by default the nominal model."""
    cpus_per_trial: float = 1.0
    """Cores."""
    gpus_per_trial: float = 0.0
    """0.25: four trials share one."""
    tracking_uri: str | None = None
    """MLflow store; by default an SQLite file in OUT."""
    no_tracking: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Do not use MLflow."""
    config: Path | None = None
    """TOML file of hyperparameters; flags override it."""
    hyperparameters: Config = Config()  # noqa: RUF009, frozen


class Base(NamedTuple):
    """What the trials of a sweep share; each replaces in ``config`` what the space draws."""

    out: Path
    config: Config
    seed: int
    env_id: str
    env_arguments: dict[str, Any]
    options: Options


def parse(words: list[str]) -> Settings:
    """Return the settings of a command line."""
    config = (tyro.conf.OmitArgPrefixes,)
    settings = tyro.cli(Settings, args=words, prog=PROG, config=config)
    if settings.config is not None:
        hyperparameters = Config(**settings_in_file(settings.config))
        default = dataclasses.replace(settings, hyperparameters=hyperparameters)
        settings = tyro.cli(Settings, args=words, prog=PROG, config=config, default=default)
    return settings


def prepare(settings: Settings) -> tuple[Base, dict[str, Any]]:
    """Return what the trials share, and the space; nothing has been written."""
    if settings.trials < 1:
        raise ConfigError(f"--trials: found {settings.trials}, expected at least 1")
    space, out, config = read_space(settings.space), settings.out.resolve(), settings.hyperparameters
    if out.exists() and any(out.iterdir()):
        raise ConfigError(f"--out: {out} holds files, expected a new folder or an empty one")
    fixed = {name for name, value in dataclasses.asdict(config).items() if value != getattr(Config(), name)}
    if both := fixed & set(space):
        raise ConfigError(f"{', '.join(sorted(both))}: drawn by {settings.space}, and given as well")
    track = str(Path(settings.track).resolve()) if settings.track.endswith(".toml") else settings.track
    model = None if settings.model is None else settings.model.resolve()
    env_arguments: dict[str, Any] = {"track": track, "model": model}
    Trainer(config, settings.env_id, **env_arguments)  # refuses what no trial could use
    uri = None if settings.no_tracking else settings.tracking_uri or local_uri(out)
    options = Options(evaluate_every=config.total_timesteps, tracking_uri=uri)
    return Base(out, config, settings.seed, settings.env_id, env_arguments, options), space


def run_trial(drawn: dict[str, Any], base: Base) -> None:
    """Train with drawn settings in a process of its own, and report every evaluation to Ray Tune."""

    def report(steps: int, evaluation: dict[str, float]) -> None:
        tune.report({METRIC: 0.0, "steps": steps, **evaluation})

    fields: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in drawn.items()}
    out = base.out / Path(tune.get_context().get_trial_dir()).name
    trainer = Trainer(dataclasses.replace(base.config, **fields), base.env_id, **base.env_arguments)
    trainer.train(out, base.seed, base.options._replace(report=report))


def run_trials(base: Base, space: dict[str, Any], settings: Settings) -> ResultGrid:
    """Run the trials with Ray Tune; return its results."""
    resources = {"cpu": settings.cpus_per_trial, "gpu": settings.gpus_per_trial}
    os.environ.update(QUIET)
    with warnings.catch_warnings():
        # JAX warns of any fork; Ray's become other programs at once.
        warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
        ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    try:
        tuner = tune.Tuner(
            tune.with_resources(tune.with_parameters(run_trial, base=base), resources),
            param_space=space,
            tune_config=tune.TuneConfig(
                num_samples=settings.trials,
                search_alg=tune.search.BasicVariantGenerator(random_state=settings.seed),
                trial_dirname_creator=lambda trial: f"trial{int(trial.trial_id.rsplit('_', 1)[-1])}",
            ),
            run_config=tune.RunConfig(name="ray", storage_path=str(base.out), verbose=1),
        )
        return tuner.fit()
    finally:
        ray.shutdown()


def run(base: Base, space: dict[str, Any], settings: Settings) -> ResultGrid:
    """Run the sweep as an MLflow run; write and print Ray's table of the results."""
    base.out.mkdir(parents=True, exist_ok=True)
    uri, tracker = base.options.tracking_uri, None
    if uri is not None:
        params = {"space": load_toml(settings.space), "trials": settings.trials, "seed": base.seed}
        params["env_id"] = base.env_id
        tracker = Tracker(base.out, uri, f"sweep {settings.space.stem}", params)
        tracker.begin()
        base = base._replace(options=base.options._replace(parent_run_id=tracker.run_id or None))
    status = "FAILED"
    try:
        results = run_trials(base, space, settings)
        table = results.get_dataframe()
        path = base.out / "sweep.csv"
        write_atomically(path, table.to_csv(index=False).encode())
        if tracker is not None:
            tracker.file(path, "sweep")
        status = "FINISHED"
    finally:
        if tracker is not None:
            tracker.end(status)
    if METRIC in table:
        shown = [name for name in table if name == METRIC or "lap_s" in name or name.startswith("config/")]
        print(table.sort_values(METRIC, ascending=False)[shown].to_string(index=False))
        best = results.get_best_result(METRIC, "max")
        print(f"best: {base.out / Path(best.path).name}, success {(best.metrics or {})[METRIC]:.1%}")
    for error in results.errors:
        print(f"failed: {str(error).strip().splitlines()[-1]}", file=sys.stderr)
    return results


def main() -> None:
    """Run the sweep as the command line says; exit 1 where every trial failed."""
    try:
        settings = parse(sys.argv[1:])
        base, space = prepare(settings)
    except (ValueError, OSError) as error:
        print(f"{PROG}: error: {error}", file=sys.stderr)
        raise SystemExit(2) from error
    results = run(base, space, settings)
    if results.num_errors == len(results):
        print(f"{PROG}: error: every trial failed; their logs are in {base.out / 'ray'}", file=sys.stderr)
        raise SystemExit(1)


if __name__ == "__main__":
    main()
