"""One trial of a sweep: a training in a process of its own, whose evaluations Ray Tune is told."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

from ray import tune

from baselines.purejaxrl_ppo.config import Config
from baselines.purejaxrl_ppo.options import Options, write_options
from baselines.purejaxrl_ppo.training import Trainer


class Base(NamedTuple):
    """What the trials of a sweep share.

    config: of which each trial replaces what the space draws. env_arguments: of ``flytrack_env.make``.
    """

    out: Path
    config: Config
    seed: int
    env_id: str
    env_arguments: dict[str, Any]
    options: Options


def folder_of(base: Base, trial_id: str) -> Path:
    """Return where a trial writes: Ray numbers them at the end of their names."""
    return base.out / f"trial{int(trial_id.rsplit('_', 1)[-1])}"


def run_trial(settings: dict[str, Any], base: Base) -> None:
    """Train with these settings; report every evaluation."""

    def report(steps: int, evaluation: dict[str, float]) -> None:
        tune.report({"steps": steps, **evaluation})

    drawn: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in settings.items()}
    config = dataclasses.replace(base.config, **drawn)
    out = folder_of(base, tune.get_context().get_trial_id())
    write_options(out, base.options)
    options = base.options._replace(report=report)
    Trainer(config, base.env_id, **base.env_arguments).train(out, base.seed, options)
