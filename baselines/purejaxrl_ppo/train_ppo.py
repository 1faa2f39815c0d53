"""Train PPO on a FlyTrack environment: ``python -m baselines.purejaxrl_ppo.train_ppo`` (docs/baseline.md)."""

import argparse
import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

from baselines.purejaxrl_ppo.checkpoint import Checkpoint
from baselines.purejaxrl_ppo.config import Config, add_flags, settings_of
from baselines.purejaxrl_ppo.resume import FINAL, checkpoints_in, newest_intact
from baselines.purejaxrl_ppo.tracking import local_uri
from baselines.purejaxrl_ppo.training import Options, Trainer, train_policy
from flytrack_env.model_file import model_from_json

__all__ = ["main", "train_policy"]

MAX_SEED = 2**31
DEFAULT_OUT = Path("runs/train")
DEFAULT_ENV_ID, DEFAULT_TRACK = "FlyTrack-v0", "flytrack"
DEFAULTS = Options(checkpoint_every=1_000_000, evaluate_every=2_000_000)


def whole_number(text: str) -> int:
    """Return a whole number, also one written as 1e6."""
    try:
        value = int(float(text))
    except (ValueError, OverflowError) as error:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a whole number") from error
    if value != float(text):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a whole number")
    return value


def reward_weight(text: str) -> tuple[str, float]:
    """Return the term and the weight of ``TERM=WEIGHT``."""
    name, _, weight = text.partition("=")
    try:
        return name, float(weight)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected TERM=WEIGHT") from error


def make_parser() -> argparse.ArgumentParser:
    """Return the command line: what is trained and told, and one flag per hyperparameter."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env-id", help=f"default: {DEFAULT_ENV_ID}")
    parser.add_argument("--track", help=f"name of a track, or path of its file (default: {DEFAULT_TRACK})")
    parser.add_argument("--model", help="path of a model file; the nominal model if not given")
    parser.add_argument(
        "--reward",
        type=reward_weight,
        nargs="+",
        metavar="TERM=WEIGHT",
        help="weights of reward terms (docs/envs); the others are default",
    )
    parser.add_argument("--seed", type=int, help="default: 0")
    parser.add_argument(
        "--num-seeds", type=int, default=1, help="train seeds seed, seed + 1, ..., each in OUT/seed<N>"
    )
    parser.add_argument("--out", type=Path, help=f"folder (default: {DEFAULT_OUT}, or that of --resume)")
    parser.add_argument(
        "--resume",
        type=Path,
        metavar="FILE_OR_DIR",
        help="go on from a checkpoint, or a folder's newest intact one; what is not given is as there",
    )
    intervals = (
        ("--checkpoint-every", "write step_<N>.msgpack every so many environment steps; 0: only at the end"),
        ("--evaluate-every", "fly and draw the policy every so many environment steps; 0: never"),
        ("--evaluation-episodes", "noisy starts of an evaluation"),
    )
    for flag, text in intervals:
        default = getattr(DEFAULTS, flag[2:].replace("-", "_"))
        parser.add_argument(flag, type=whole_number, default=default, help=f"{text} (default: {default})")
    parser.add_argument("--tracking-uri", help="MLflow store (default: an SQLite file in OUT)")
    parser.add_argument("--no-tracking", action="store_true", help="tell MLflow nothing")
    add_flags(parser)
    return parser


class Plan(NamedTuple):
    """One seed's run: where it writes, and the checkpoint that it goes on from, if any."""

    seed: int
    out: Path
    resume: Path | None = None
    checkpoint: Checkpoint | None = None


def root_folder(arguments: argparse.Namespace) -> Path:
    """Return the folder that everything is written to."""
    resume = arguments.resume
    if arguments.out is not None or resume is None:
        return arguments.out or DEFAULT_OUT
    return resume if resume.is_dir() else resume.parent


def make_plans(arguments: argparse.Namespace) -> list[Plan]:
    """Return one plan per seed; of several seeds, those that have no checkpoint begin.

    Raises:
        ValueError: no such seed, a checkpoint that cannot be used, or a folder that holds another run.
    """
    seed, is_one = arguments.seed, arguments.num_seeds == 1
    if arguments.num_seeds < 1:
        raise ValueError(f"--num-seeds: found {arguments.num_seeds}, expected at least 1")
    out = root_folder(arguments)
    if is_one and arguments.resume is not None:
        path, checkpoint = newest_intact(arguments.resume)
        return [Plan(checkpoint.meta["seed"] if seed is None else seed, out, path, checkpoint)]
    if arguments.resume is not None and not arguments.resume.is_dir():
        raise ValueError(f"--resume: found {arguments.resume}, expected the folder that holds seed<N>")
    first = seed or 0
    if not 0 <= first <= MAX_SEED - arguments.num_seeds:
        raise ValueError(f"--seed: found {first}, expected 0 to {MAX_SEED - arguments.num_seeds}")
    plans = []
    for seed in range(first, first + arguments.num_seeds):
        folder = out if is_one else out / f"seed{seed}"
        source = None if arguments.resume is None else arguments.resume / f"seed{seed}"
        if source is not None and checkpoints_in(source):
            plans.append(Plan(seed, folder, *newest_intact(source)))
        elif checkpoints_in(folder):
            raise ValueError(f"--out: {folder} holds the checkpoints of a run; --resume it, or give another")
        else:
            plans.append(Plan(seed, folder))
    return plans


def make_trainer(arguments: argparse.Namespace, base: Checkpoint | None) -> Trainer:
    """Return the trainer of a command line; what it does not say is as in the checkpoint, if there is one."""
    asked = settings_of(arguments)
    if base is None:
        env_arguments: dict[str, Any] = {
            "track": arguments.track or DEFAULT_TRACK,
            "model": arguments.model,
            "reward": dict(arguments.reward or ()),
        }
        return Trainer(Config(**asked), arguments.env_id or DEFAULT_ENV_ID, **env_arguments)
    env_arguments = {
        "track": arguments.track or base.track,
        "model": arguments.model or model_from_json(base.meta["model"], "checkpoint: model"),
        "missed_gate": base.meta["missed_gate"],
        "reward": {**reward_of(base), **dict(arguments.reward or ())},
    }
    config = dataclasses.replace(base.config, **asked)
    return Trainer(config, arguments.env_id or base.env_id, **env_arguments)


def reward_of(checkpoint: Checkpoint) -> dict[str, float]:
    """Return the weights of the reward terms that a checkpoint was trained with."""
    prefix = "reward."
    values = checkpoint.meta["environment"].items()
    return {name.removeprefix(prefix): value for name, value in values if name.startswith(prefix)}


def run(arguments: argparse.Namespace) -> None:
    """Train every seed that a command line asks for.

    Raises:
        ValueError, OSError: what cannot be used, before any training.
    """
    out = root_folder(arguments)
    options = Options(
        checkpoint_every=arguments.checkpoint_every or None,
        evaluate_every=arguments.evaluate_every or None,
        evaluation_episodes=arguments.evaluation_episodes,
        tracking_uri=None if arguments.no_tracking else arguments.tracking_uri or local_uri(out),
    )
    options.check()
    plans = make_plans(arguments)
    base = next((plan.checkpoint for plan in plans if plan.checkpoint is not None), None)
    trainer = make_trainer(arguments, base)
    for plan in plans:
        checkpoint, _ = trainer.train(plan.out, plan.seed, options._replace(resume=plan.resume))
        meta = checkpoint.meta
        print(f"seed {plan.seed}: {meta['steps']} steps in {meta['seconds']} s: {plan.out / FINAL}")


def main() -> None:
    """Parse the command line, train, say where the checkpoints are."""
    parser = make_parser()
    arguments = parser.parse_args()
    try:
        run(arguments)
    except (ValueError, OverflowError, OSError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
