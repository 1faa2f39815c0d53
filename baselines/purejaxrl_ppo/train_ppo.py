"""Train PPO on a FlyTrack environment: ``python -m baselines.purejaxrl_ppo.train_ppo`` (docs/baseline.md)."""

import argparse
import os
import sys
from pathlib import Path
from typing import NamedTuple, NoReturn

import jax

from baselines.joining import add_job_flags, begin_anew, job_of
from baselines.purejaxrl_ppo.config import add_flags
from baselines.purejaxrl_ppo.distributed import all_devices, is_first, wait_for_all
from baselines.purejaxrl_ppo.options import OPTIONS, Options, options_as_bytes
from baselines.purejaxrl_ppo.plans import (
    DEFAULT_ENV_ID,
    DEFAULT_OUT,
    DEFAULT_TRACK,
    DEFAULTS,
    Plan,
    batched,
    check_plans,
    make_plans,
    make_trainer,
    options_of,
    root_folder,
)
from baselines.purejaxrl_ppo.resume import own_start, take_over
from baselines.purejaxrl_ppo.run_folder import FINAL, checkpoints_in, seeds_in
from baselines.purejaxrl_ppo.training import Trainer, train_policy

__all__ = ["DEFAULTS", "main", "train_policy"]

INTERRUPTED = 130  # what shells return for a command that Ctrl-C ended


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
    parser = argparse.ArgumentParser(
        prog="train_ppo",
        usage="%(prog)s [options]",
        description="Train PPO on a FlyTrack environment; docs/baseline.md describes what comes of it.",
    )
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
    parser.add_argument("--seed", type=int, metavar="N", help="default: 0, or as in the checkpoint")
    parser.add_argument(
        "--num-seeds",
        type=int,
        metavar="N",
        help="train N seeds from --seed on, side by side in one program, each in OUT/seed<N> (default: 1, "
        "or as many as --resume holds)",
    )
    parser.add_argument(
        "--seeds-at-once",
        type=int,
        metavar="N",
        help="so many of them side by side, the others after them; on a CPU 1 is quickest (default: all, or "
        "as before)",
    )
    parser.add_argument("--out", type=Path, help=f"folder (default: {DEFAULT_OUT}, or that of --resume)")
    parser.add_argument(
        "--resume",
        type=Path,
        metavar="FILE_OR_DIR",
        help="go on from a checkpoint, from a folder's newest intact one, or with all seeds in a folder of "
        "seed<N>; what is not given is as it was: settings from the checkpoint, the five options below from "
        "options.json beside it",
    )
    intervals = (
        ("--checkpoint-every", "write step_<N>.msgpack every N environment steps; 0: only at the end"),
        ("--evaluate-every", "fly and draw the policy every N environment steps; 0: never"),
        ("--evaluation-episodes", "noisy starts of an evaluation"),
    )
    for flag, text in intervals:
        default = getattr(DEFAULTS, flag[2:].replace("-", "_"))
        parser.add_argument(flag, type=whole_number, metavar="N", help=f"{text} (default: {default})")
    tracking = parser.add_mutually_exclusive_group()
    tracking.add_argument(
        "--tracking-uri", metavar="URI", help="MLflow store (default: an SQLite file in OUT)"
    )
    tracking.add_argument("--no-tracking", action="store_true", help="tell MLflow nothing")
    add_job_flags(parser)
    add_flags(parser)
    return parser


class Asked(NamedTuple):
    """What a command line asks for, checked: one trainer, and for every seed where to and how."""

    trainer: Trainer
    plans: list[Plan]
    options: list[Options]


def prepare(arguments: argparse.Namespace) -> Asked:
    """Return what is to be done.

    Raises:
        ValueError, OSError: what cannot be used; nothing has been written.
    """
    plans = make_plans(arguments)
    options = options_of(arguments, plans)
    base = next((plan for plan in plans if plan.checkpoint is not None), None)
    mesh = all_devices() if arguments.distributed else None
    trainer = make_trainer(arguments, base, mesh)
    check_plans(trainer, plans)
    if trainer.mesh is not None:
        wait_for_all("prepared")  # before the first process writes what the others would find
    return Asked(trainer, plans, options)


def say_resumed(plan: Plan) -> str | None:
    """Return the line for a seed that is gone on with, None for one that begins."""
    if plan.resume is None or plan.checkpoint is None:
        return None
    return f"seed {plan.seed}: from step {plan.checkpoint.meta['steps']}, {plan.resume}"


def begin_folders(asked: Asked) -> list[Options]:
    """Have in every seed's folder what it goes on from, and its options; return these.

    All before any is trained: whoever takes them up again finds the seeds that had not begun.
    """
    starts = {
        plan.out: (plan.resume, plan.checkpoint) for plan in asked.plans if plan.checkpoint and plan.resume
    }
    paths = {out: own_start(out, start) for out, start in starts.items()}
    every = [
        options._replace(resume=paths.get(plan.out, plan.resume))
        for plan, options in zip(asked.plans, asked.options, strict=True)
    ]
    beside = (
        (plan.out / OPTIONS, options_as_bytes(plan.out, options))
        for plan, options in zip(asked.plans, every, strict=True)
        if not (plan.out / FINAL).exists()
    )
    take_over(list(starts.items()), beside)
    if asked.trainer.mesh is not None:
        wait_for_all("taken over")  # before the others look for what the first process wrote
    return every


def run(asked: Asked) -> None:
    """Train every seed; say from where those go on that had begun, and where its checkpoint is."""
    for line in filter(None, map(say_resumed, asked.plans)):
        if is_first():
            print(line)
    all_options = begin_folders(asked)
    all_seeds = [
        (plan.out, plan.seed, options) for plan, options in zip(asked.plans, all_options, strict=True)
    ]
    # On several devices one seed after the other: a seed fills them.
    at_once = asked.plans[0].at_once if asked.trainer.mesh is None else 1
    for seeds in batched(all_seeds, at_once):
        for (out, seed, _), (checkpoint, _) in zip(seeds, asked.trainer.train_all(seeds), strict=True):
            meta = checkpoint.meta
            if is_first():
                print(f"seed {seed}: {meta['steps']} steps in {meta['seconds']} s: {out / FINAL}")


def say_stopped(steps: int, arguments: argparse.Namespace) -> str:
    """Return the line for who has stopped the training."""
    out = root_folder(arguments)
    folders = [out, *(out / f"seed{seed}" for seed in seeds_in(out))]
    if any(checkpoints_in(folder) for folder in folders):
        return f"stopped at {steps} steps; go on with --resume {out}"
    return f"stopped at {steps} steps, before the first checkpoint"


def say_lost(steps: int, arguments: argparse.Namespace, error: Exception) -> str:
    """Return the line for who has lost another process of the training."""
    reason = (str(error).splitlines() or [""])[0]
    return (
        f"process {jax.process_index()} of {jax.process_count()} has lost another ({reason}); "
        f"{say_stopped(steps, arguments)}, with any number of processes"
    )


def leave(status: int, text: str) -> NoReturn:
    """End with a message; of several processes at once, because those that are left would wait for it."""
    print(text, file=sys.stderr, flush=True)
    if jax.process_count() > 1:
        os._exit(status)
    raise SystemExit(status)


def main(has_joined: bool = False) -> None:
    """Parse the command line, train, say where the checkpoints are.

    has_joined: whether this process has met the others of its training.
    """
    parser = make_parser()
    arguments = parser.parse_args()
    error = f"{parser.prog}: error:"
    try:
        job_of(arguments)
        if arguments.distributed and not has_joined:
            begin_anew()
        asked = prepare(arguments)
    except (ValueError, OverflowError, OSError) as found:
        leave(2, f"{parser.format_usage()}{error} {found}")
    try:
        run(asked)
    except KeyboardInterrupt:
        leave(INTERRUPTED, say_stopped(asked.trainer.steps, arguments))
    except (ValueError, OSError) as found:
        leave(1, f"{error} {found}")
    except jax.errors.JaxRuntimeError as found:
        if jax.process_count() == 1:
            raise
        leave(1, f"{error} {say_lost(asked.trainer.steps, arguments, found)}")


if __name__ == "__main__":
    main()
