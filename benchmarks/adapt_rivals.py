"""Policies that are trained once, for plants around a model: ``python -m benchmarks.adapt_rivals``.

They are made as ``robust`` is (``benchmarks.champion``), PPO and then polishing, from the same
model. Three learn from plants that differ from it by up to 10, 20 and 30 % in mass, each lag and
the size of each effect, as R. Ferede et al. draw parameters ("One net to rule them all", 2025). A
fourth remembers the flight, so that it can find out what it flies; it is not polished, which would
take 40 minutes. Rates, the shape of the thrust map and effects that the model lacks are not drawn.
What is in runs/adapt is not trained again.
"""

from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import flytrack_env
from baselines.purejaxrl_ppo import Config, load_checkpoint
from baselines.purejaxrl_ppo.checkpoint import describe_run, save_checkpoint
from baselines.purejaxrl_ppo.networks import Policy
from baselines.purejaxrl_ppo.polish import polish
from baselines.purejaxrl_ppo.ppo import make_network_for, make_ppo
from baselines.purejaxrl_ppo.training import training_params
from benchmarks import report
from benchmarks.champion import CHANGES, MODEL, RECIPES, REWARD
from flytrack_env.dynamics import ModelParameters
from flytrack_env.progress import ProgressBar, progress_bar
from flytrack_env.wrappers import DomainRandomization, RandomizationParams
from flytrack_env.wrappers.domain_randomization import sample_model

RUNS = Path("runs/adapt")
SEED, STEPS = 0, 40_000_000
ROBUST = RECIPES["robust"]


class Rival(NamedTuple):
    """How plants are drawn for a policy, and the width of its memory.

    Attributes:
        share: by which a plant differs at most.
        memory_size: 0 for a policy without memory.
    """

    share: float
    memory_size: int = 0


POLICIES = {
    "randomised 10 %": Rival(0.1),
    "randomised 20 %": Rival(0.2),
    "randomised 30 %": Rival(0.3),
    "recurrent 30 %": Rival(0.3, 32),
}


def make_ranges(share: float, model: ModelParameters) -> RandomizationParams:
    """Return ranges in which mass, lags and effects of a model differ from it by up to a share."""
    low, high = 1.0 - share, 1.0 + share
    effects = model.effects  # those that the model has are scaled, whatever their bounds here
    return RandomizationParams(low, high, low, high, low, high, low=effects, high=effects)


def draw_within(
    ranges: RandomizationParams, key: jax.Array, model: ModelParameters
) -> ModelParameters:
    """Draw the model of a plant around a model."""
    drawn = sample_model(jax.random.bits(key, (), jnp.uint32), model, ranges)
    return drawn._replace(tau=jnp.stack(list(drawn.tau)))


def train_rival(name: str) -> Path:
    """Train a policy unless it is there; return its file."""
    path = RUNS / f"{name.replace(' %', '').replace(' ', '_')}.safetensors"
    if path.exists():
        return path
    rival = POLICIES[name]
    changes = {**CHANGES, **ROBUST.changes, "memory_size": rival.memory_size}
    config = Config(total_timesteps=STEPS, **changes)
    env = flytrack_env.make(ROBUST.env_id, model=MODEL, reward=REWARD)
    params = training_params(env, config)
    ranges = make_ranges(rival.share, params.model)
    params = params.replace(wrappers={**params.wrappers, DomainRandomization.key: ranges})
    ppo = make_ppo(env, params, config)
    runner, update = jax.jit(ppo.start)(jax.random.key(SEED)), jax.jit(ppo.update, donate_argnums=0)
    with closing(progress_bar("updates", config.num_updates, desc=name)) as bar:
        for _ in range(config.num_updates):
            runner, _ = update(runner)
            bar.update(1)
    network = make_network_for(env, params, config)
    race = flytrack_env.make("FlyTrack-v0", model=MODEL)
    model = jax.tree.map(jnp.asarray, race.default_params.model)
    final = runner.train_state.params
    if not rival.memory_size:
        final = polish(
            race,
            Policy(network, final),
            SEED,
            ROBUST.settings,
            lambda key, way: draw_within(ranges, key, model),
            ProgressBar("updates"),
        )
    description = describe_run(race, "FlyTrack-v0", "flytrack", config, SEED)
    save_checkpoint(path, final, config, description)
    return path


def main() -> None:
    """Train the policies that are missing."""
    for name in POLICIES:
        policy = load_checkpoint(train_rival(name))
        size = sum(np.size(leaf) for leaf in jax.tree.leaves(policy.policy.params))
        print(f"{name}: {policy.path}, {size} parameters")


if __name__ == "__main__":
    report.command(main)
