"""Resuming a training from a stranger's checkpoint, as far as the training itself."""

import argparse
import functools
from pathlib import Path
from typing import Any

import jax
import numpy as np

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.checkpoint import save_checkpoint
from baselines.purejaxrl_ppo.named_arrays import as_named_arrays, is_key
from baselines.purejaxrl_ppo.plans import check_plans, make_plans, make_trainer
from baselines.purejaxrl_ppo.resume import check_same_run, restore_runner
from baselines.purejaxrl_ppo.train_ppo import make_parser
from baselines.purejaxrl_ppo.training import Trainer

SEED = 3
CONFIG = Config(total_timesteps=64, num_envs=2, num_steps=4, num_minibatches=2, hidden_sizes=(3,))


@functools.cache
def _trainer() -> Trainer:
    return Trainer(CONFIG)


@functools.cache
def _target() -> Any:
    """Return the shapes and types of a training's state."""
    return jax.eval_shape(_trainer().start, jax.random.key(SEED))


def _zeros(leaf: Any) -> jax.Array:
    if is_key(leaf):
        words = jax.eval_shape(jax.random.key_data, leaf)
        return jax.random.wrap_key_data(np.zeros(words.shape, words.dtype))
    return np.zeros(leaf.shape, leaf.dtype)


def write_trainings(folder: Path) -> None:
    """Write a checkpoint of a training that has not begun, and one further on."""
    runner = jax.tree.map(_zeros, _target())
    rest = as_named_arrays(runner._replace(train_state=runner.train_state.replace(params=None)))
    params = runner.train_state.params
    for name, updates in (("a", 0), ("b", 2)):
        progress = {"steps": updates * CONFIG.batch_size, "seconds": 1.5, "seen": {"success": 0.5}}
        description = {**_trainer().describe(SEED), **progress}
        save_checkpoint(folder / f"{name}.msgpack", params, CONFIG, description, rest)


@functools.cache
def _parser() -> argparse.ArgumentParser:
    return make_parser()  # it compiles a part of the package to read what it says of itself


def resume(path: Path) -> tuple[Any, int]:
    """Return the state that the command would go on from, with the settings in the file, and its steps."""
    arguments = _parser().parse_args(["--resume", str(path), "--no-tracking"])
    (plan,) = make_plans(arguments)
    assert plan.resume is not None and plan.checkpoint is not None
    check_plans(make_trainer(arguments, plan), [plan])
    check_same_run(plan.resume, plan.checkpoint, _trainer().describe(SEED))
    return restore_runner(plan.resume, plan.checkpoint, _target()), plan.checkpoint.meta["steps"]
