"""Trains with many settings: ``python -m baselines.purejaxrl_ppo.sweeps SPACE.toml --trials 16``.

SPACE.toml says how settings are drawn (docs/scaling.md); all others are as flags say. Ray Tune starts the
trials, on this machine or, where RAY_ADDRESS names one, on a cluster that sees the same folder. In MLflow
every trial is a run below that of the sweep.
"""

import argparse
import logging
import os
import warnings
from pathlib import Path
from typing import Any

import ray
from ray import tune
from tqdm import tqdm

from baselines.purejaxrl_ppo.config import Config, ConfigError, add_flags, settings_of
from baselines.purejaxrl_ppo.journal import Journal
from baselines.purejaxrl_ppo.options import Options
from baselines.purejaxrl_ppo.sweeps.results import Trial, table, write_results
from baselines.purejaxrl_ppo.sweeps.space import Space, for_tune, points_of, read_space
from baselines.purejaxrl_ppo.sweeps.trial import Base, folder_of, run_trial
from baselines.purejaxrl_ppo.tracking import Tracker, local_uri
from baselines.purejaxrl_ppo.training import Trainer

QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AIR_NEW_OUTPUT": "0", "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1"}


class Bar(tune.Callback):
    """Shows how many trials have ended."""

    def __init__(self, number: int):
        self.bar = tqdm(total=number, unit="trial")

    def on_trial_complete(self, iteration: int, trials: Any, trial: Any, **info: Any) -> None:
        """Count a trial."""
        self.bar.update()

    def on_trial_error(self, iteration: int, trials: Any, trial: Any, **info: Any) -> None:
        """Count a trial that failed."""
        self.bar.update()


def make_parser() -> argparse.ArgumentParser:
    """Return the command line: the space, the trials, and what all of them share."""
    parser = argparse.ArgumentParser(prog="sweeps", usage="%(prog)s SPACE [options]", description=__doc__)
    parser.add_argument("space", type=Path, help="TOML file of the settings that are drawn")
    parser.add_argument(
        "--trials",
        type=int,
        default=16,
        help="draws, each of every point of the grid if there is one (default: %(default)s)",
    )
    parser.add_argument("--out", type=Path, default=Path("runs/sweep"), help="folder (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the draws and of every training")
    parser.add_argument("--env-id", default="FlyTrack-v0", help="default: %(default)s")
    parser.add_argument("--track", default="flytrack", help="name or path (default: %(default)s)")
    parser.add_argument("--model", help="path of a model file; the nominal model if not given")
    parser.add_argument("--cpus-per-trial", type=float, default=1.0, help="cores (default: %(default)g)")
    parser.add_argument("--gpus-per-trial", type=float, default=0.0, help="0.25: four share one")
    tracking = parser.add_mutually_exclusive_group()
    tracking.add_argument("--tracking-uri", help="MLflow store (default: an SQLite file in OUT)")
    tracking.add_argument("--no-tracking", action="store_true", help="tell MLflow nothing")
    add_flags(parser)
    return parser


def prepare(arguments: argparse.Namespace) -> tuple[Base, Space]:
    """Return what the trials share, and the space; nothing has been written.

    Raises:
        ValueError: what cannot be used.
    """
    if arguments.trials < 1:
        raise ConfigError(f"--trials: found {arguments.trials}, expected at least 1")
    space, out = read_space(arguments.space), arguments.out.resolve()
    if out.exists() and any(out.iterdir()):
        raise ConfigError(f"--out: {out} holds files, expected a new folder or an empty one")
    fixed = settings_of(arguments)
    if both := set(fixed) & set(space):
        raise ConfigError(f"{', '.join(sorted(both))}: drawn by {arguments.space}, and given as well")
    config = Config(**fixed)
    track = str(Path(arguments.track).resolve()) if arguments.track.endswith(".toml") else arguments.track
    model = None if arguments.model is None else str(Path(arguments.model).resolve())
    env_arguments: dict[str, Any] = {"track": track, "model": model}
    Trainer(config, arguments.env_id, **env_arguments)  # refuses what no trial could use
    uri = None if arguments.no_tracking else arguments.tracking_uri or local_uri(out)
    options = Options(evaluate_every=config.total_timesteps, tracking_uri=uri, parent=out)
    return Base(out, config, arguments.seed, arguments.env_id, env_arguments, options), space


def run_trials(base: Base, space: Space, arguments: argparse.Namespace) -> list[Trial]:
    """Have Ray Tune run the trials; return what came of them."""
    resources = {"cpu": arguments.cpus_per_trial, "gpu": arguments.gpus_per_trial}
    os.environ.update(QUIET)
    with warnings.catch_warnings():
        # JAX warns of any fork; these become other programs at once.
        warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
        ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    draws = tune.search.BasicVariantGenerator(random_state=arguments.seed)
    bar = Bar(arguments.trials * points_of(space))
    try:
        tuner = tune.Tuner(
            tune.with_resources(tune.with_parameters(run_trial, base=base), resources),
            param_space=for_tune(space),
            tune_config=tune.TuneConfig(
                num_samples=arguments.trials,
                search_alg=draws,
                trial_dirname_creator=lambda trial: folder_of(base, trial.trial_id).name,
            ),
            run_config=tune.RunConfig(name="ray", storage_path=str(base.out), verbose=0, callbacks=[bar]),
        )
        results = tuner.fit()
        return [_trial(base, results[index]) for index in range(len(results))]
    finally:
        bar.bar.close()
        ray.shutdown()


def _trial(base: Base, result: Any) -> Trial:
    metrics = result.metrics or {}
    evaluation = {name: value for name, value in metrics.items() if name.startswith("evaluation_")}
    error = None if result.error is None else str(result.error).strip().splitlines()[-1]
    return Trial(base.out / Path(result.path).name, result.config, evaluation, error)


def run(base: Base, space: Space, arguments: argparse.Namespace) -> list[Trial]:
    """Run the sweep, tell MLflow, write and print what came of it."""
    options = base.options
    tracker = None
    base.out.mkdir(parents=True, exist_ok=True)
    if options.tracking_uri is not None:
        params = {"space": space, "trials": arguments.trials, "seed": base.seed, "env_id": base.env_id}
        tracker = Tracker(base.out, options.tracking_uri, f"sweep {arguments.space.stem}", params)
        tracker.begin()
    status = "FAILED"
    try:
        trials = run_trials(base, space, arguments)
        for path in write_results(base.out, trials):
            if tracker is not None:
                tracker.file(path, "sweep")
        status = "FINISHED"
    finally:
        if tracker is not None:
            send_rest(tracker, base.out)
            tracker.end(status)
    print(table(trials))
    return trials


def send_rest(tracker: Tracker, out: Path) -> None:
    """Send what trials could not while others wrote to the store."""
    for folder in sorted(out.glob("trial*")):
        journal = Journal(folder)
        if journal.of_kind("run") and not journal.is_sent():
            tracker.send(journal)


def main() -> None:
    """Parse the command line and run the sweep; exit 1 where every trial failed."""
    parser = make_parser()
    arguments = parser.parse_args()
    try:
        base, space = prepare(arguments)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    if all(trial.error is not None for trial in run(base, space, arguments)):
        parser.exit(1, f"{parser.prog}: error: every trial failed; what they said is in {base.out / 'ray'}\n")


if __name__ == "__main__":
    main()
