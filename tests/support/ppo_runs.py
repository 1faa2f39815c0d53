"""Small training runs that the tests of the baseline share: settings, a trainer, comparisons."""

from functools import cache

import jax
import numpy as np

from baselines.purejaxrl_ppo import Config, load_checkpoint
from baselines.purejaxrl_ppo.training import Options, Trainer

SEED = 3
ENV_ID = "FlyTrackNoisy-v0"  # whose episodes remember the word of their noise
BATCH = 16 * 24
CONFIG = Config(
    total_timesteps=7 * BATCH, num_envs=16, num_steps=24, num_minibatches=4, hidden_sizes=(8,)
)
EVERY_OTHER_UPDATE = Options(checkpoint_every=2 * BATCH)
DEAD_URI = "http://127.0.0.1:9"  # the port at which nothing listens


@cache
def make_trainer():
    """Return the trainer, compiled once for all tests of a process."""
    return Trainer(CONFIG, ENV_ID)


def assert_same_end(path, expected):
    """Compare every array, and the description but for the time it took."""
    checkpoint, reference = load_checkpoint(path), load_checkpoint(expected)
    jax.tree.map(np.testing.assert_array_equal, checkpoint.params, reference.params)
    assert checkpoint.training.keys() == reference.training.keys()
    for name, array in reference.training.items():
        assert checkpoint.training[name].tobytes() == array.tobytes(), name
    metas = [
        {n: v for n, v in each.meta.items() if n != "seconds"} for each in (checkpoint, reference)
    ]
    assert metas[0] == metas[1]
