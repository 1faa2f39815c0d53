"""What a command line of the training asks for: which seeds, from where to where, with which trainer."""

import argparse
import dataclasses
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from jax.sharding import Mesh

from baselines.purejaxrl_ppo.checkpoint import Checkpoint, CheckpointError
from baselines.purejaxrl_ppo.config import Config, settings_of
from baselines.purejaxrl_ppo.options import INTERVALS, Options, read_options
from baselines.purejaxrl_ppo.resume import (
    REWARD,
    at_common_step,
    check_same_run,
    newest_intact,
    seeds_side_by_side,
)
from baselines.purejaxrl_ppo.run_folder import check_free, checkpoints_in, folder_of, seeds_in
from baselines.purejaxrl_ppo.tracking import local_uri
from baselines.purejaxrl_ppo.training import Trainer
from flytrack_env.messages import error_text
from flytrack_env.model_file import model_from_json

T = TypeVar("T")

MAX_SEED = 2**31
DEFAULT_OUT = Path("runs/train")
DEFAULT_ENV_ID, DEFAULT_TRACK = "FlyTrack-v0", "flytrack"
DEFAULTS = Options(checkpoint_every=1_000_000, evaluate_every=4_000_000)


class Plan(NamedTuple):
    """One seed's run: where it writes, and the checkpoint that it goes on from, if any.

    resume: the checkpoint's path; or the run's own folder, which was killed before it had one.
    at_once: how many seeds train side by side.
    """

    seed: int
    out: Path
    resume: Path | None = None
    checkpoint: Checkpoint | None = None
    at_once: int = 1


def root_folder(arguments: argparse.Namespace) -> Path:
    """Return the folder that everything is written to."""
    resume = arguments.resume
    if arguments.out is not None or resume is None:
        return arguments.out or DEFAULT_OUT
    return folder_of(resume)


def make_plans(arguments: argparse.Namespace) -> list[Plan]:
    """Return one plan per seed; of several seeds, those that have no checkpoint begin.

    Raises:
        ValueError: no such seed, a checkpoint that cannot be used, or a folder that holds another run.
    """
    resume, number = arguments.resume, arguments.num_seeds
    if number is not None and number < 1:
        raise ValueError(f"--num-seeds: found {number}, expected at least 1")
    if arguments.seeds_at_once is not None and arguments.seeds_at_once < 1:
        raise ValueError(f"--seeds-at-once: found {arguments.seeds_at_once}, expected at least 1")
    out, is_one = root_folder(arguments), (number or 1) == 1
    if resume is None:
        seeds = _seeds(arguments.seed or 0, number or 1)
        if is_one and seeds_in(out):
            raise ValueError(f"--out: {out} holds the runs of several seeds; --resume it, or give another")
        check_free(out)
        at_once = arguments.seeds_at_once or len(seeds)
        plans = [Plan(seed, out if is_one else out / f"seed{seed}", at_once=at_once) for seed in seeds]
    elif is_one and (checkpoints_in(resume) or not seeds_in(resume)):
        path, checkpoint = newest_intact(resume)
        seed = checkpoint.meta["seed"] if arguments.seed is None else arguments.seed
        plans = [Plan(seed, out, path, checkpoint)]
    else:
        plans = _plans_of_several(arguments, out)
    for plan in plans:
        check_free(plan.out, plan.resume, out)
    return plans


def _seeds(first: int, number: int) -> list[int]:
    if not 0 <= first <= MAX_SEED - number:
        raise ValueError(f"--seed: found {first}, expected 0 to {MAX_SEED - number}")
    return list(range(first, first + number))


def batched(values: list[T], size: int) -> list[list[T]]:
    """Return values in groups of a size, the last of them perhaps smaller."""
    return [values[start : start + size] for start in range(0, len(values), size)]


def _plans_of_several(arguments: argparse.Namespace, out: Path) -> list[Plan]:
    """Return the plans of seeds that are taken up again; which, the folder says where the flags do not."""
    resume = arguments.resume
    if not resume.is_dir():
        raise ValueError(f"--resume: found {resume}, expected the folder that holds seed<N>")
    seeds = found = seeds_in(resume)
    if arguments.seed is not None or arguments.num_seeds is not None:
        first = (found or [0])[0] if arguments.seed is None else arguments.seed
        seeds = _seeds(first, arguments.num_seeds or 1)
    folders = [resume / f"seed{seed}" for seed in seeds]
    starts = [newest_intact(source) if checkpoints_in(source) else None for source in folders]
    at_once = arguments.seeds_at_once or seeds_side_by_side(starts)
    starts = [start for group in batched(starts, at_once) for start in at_common_step(group)]
    is_same = out.resolve() == resume.resolve()
    found_or_own = [
        start or (source if is_same and source.is_dir() else None, None)
        for source, start in zip(folders, starts, strict=True)
    ]
    plans = [
        Plan(seed, out / source.name, path, checkpoint, at_once)
        for seed, source, (path, checkpoint) in zip(seeds, folders, found_or_own, strict=True)
    ]
    if all(plan.checkpoint is None for plan in plans):
        has = (
            "the checkpoints of one run: leave out --num-seeds"
            if checkpoints_in(resume)
            else f"seeds {found}"
        )
        raise ValueError(
            f"--resume: {resume}: found no checkpoint of seeds {seeds} in seed<N>; expected at least one. It "
            f"holds {has}; to begin again, remove it or give another folder (--out)"
        )
    return plans


def options_of(arguments: argparse.Namespace, plans: list[Plan]) -> list[Options]:
    """Return what each plan does beside training: as flags say, else as the run did before, else as usual.

    Raises:
        ValueError: numbers that cannot be used.
    """
    sources = [None if plan.resume is None else folder_of(plan.resume) for plan in plans]
    known = [None if source is None else read_options(source) for source in sources]
    usual = DEFAULTS._replace(tracking_uri=local_uri(root_folder(arguments)))
    of_others = next((options for options in known if options is not None), usual)
    given = {name: getattr(arguments, name) for name in INTERVALS if getattr(arguments, name) is not None}
    for name in ("checkpoint_every", "evaluate_every"):
        if given.get(name) == 0:
            given[name] = None
    if arguments.no_tracking or arguments.tracking_uri is not None:
        given["tracking_uri"] = arguments.tracking_uri
    found = []
    for plan, before in zip(plans, known, strict=True):
        options = (before or of_others)._replace(**given, resume=plan.resume)
        options.check()
        found.append(options)
    return found


def check_plans(trainer: Trainer, plans: list[Plan]) -> None:
    """Raise CheckpointError where a plan's checkpoint is not of the run that the trainer makes."""
    for plan in plans:
        if plan.resume is not None and plan.checkpoint is not None:
            check_same_run(plan.resume, plan.checkpoint, trainer.describe(plan.seed))


def make_trainer(arguments: argparse.Namespace, plan: Plan | None, mesh: Mesh | None = None) -> Trainer:
    """Return the trainer of a command line; what it does not say is as in a plan's checkpoint, if any.

    Raises:
        ValueError: settings that cannot be used; where a checkpoint has some of them, the message names it.
    """
    asked = settings_of(arguments)
    if plan is None or plan.checkpoint is None:
        env_arguments: dict[str, Any] = {
            "track": arguments.track or DEFAULT_TRACK,
            "model": arguments.model,
            "reward": dict(arguments.reward or ()),
        }
        return Trainer(Config(**asked), arguments.env_id or DEFAULT_ENV_ID, mesh, **env_arguments)
    base = plan.checkpoint
    try:
        env_arguments = {
            "track": arguments.track or base.track,
            "model": arguments.model or model_from_json(base.meta["model"], "model"),
            "missed_gate": base.meta["missed_gate"],
            "reward": {**reward_of(base), **dict(arguments.reward or ())},
        }
        config = dataclasses.replace(base.config, **asked)
        return Trainer(config, arguments.env_id or base.env_id, mesh, **env_arguments)
    except (ValueError, OverflowError, OSError) as error:
        raise CheckpointError(
            f"{plan.resume}: with its settings and the flags: {error_text(error)}"
        ) from error


def reward_of(checkpoint: Checkpoint) -> dict[str, float]:
    """Return the weights of the reward terms that a checkpoint was trained with."""
    values = checkpoint.meta["environment"].items()
    return {name.removeprefix(REWARD): value for name, value in values if name.startswith(REWARD)}
