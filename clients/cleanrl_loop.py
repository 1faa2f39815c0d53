"""A loop in the style of CleanRL on FlyTrack-v0, with Gymnasium's own vector wrappers."""

from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.wrappers.vector import NormalizeObservation, NormalizeReward, RecordEpisodeStatistics

from clients.flights import Outcome, outcome_of
from clients.learner import NUM_ENVS, NUM_STEPS, NUM_UPDATES, act, begin, learn

RETURN_MARGIN, GATE_MARGIN = 2.5, 1.0


def measure(seed: int) -> Outcome:
    """Train and return the results of the first and of the last episodes of the training."""
    envs: Any = RecordEpisodeStatistics(gymnasium.make_vec("flytrack_env:FlyTrack-v0", NUM_ENVS))
    envs = NormalizeReward(NormalizeObservation(envs))
    observations, _ = envs.reset(seed=seed)
    key, nothing = jax.random.key(seed), np.zeros(NUM_ENVS)
    training, had_ended, results = begin(key, observations), nothing.astype(bool), []
    for _ in range(NUM_UPDATES):
        steps = []
        for _ in range(NUM_STEPS):
            key, act_key = jax.random.split(key)
            actions = np.asarray(act(training, observations, act_key))
            following, rewards, terminated, truncated, infos = envs.step(actions)
            done = terminated | truncated
            # Where an episode had ended, this step was its reset, which the learner leaves out.
            steps.append((observations, actions, rewards, done, ~had_ended))
            episode = infos.get("episode", {"r": nothing})
            results.append((done, episode["r"], infos.get("gates_passed", nothing)))
            observations, had_ended = following, done
        training = learn(
            training, key, observations, tuple(map(np.stack, zip(*steps, strict=True)))
        )
    return outcome_of(*map(np.stack, zip(*results, strict=True)))
