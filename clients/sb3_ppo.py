"""Stable-Baselines3's PPO on FlyTrack-v0, through Gymnasium's vector environment."""

from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor

from clients.flights import EVALUATION_SEED, NUM_FLIGHTS, Outcome
from clients.sb3_vec_env import SameStepVecEnv

RETURN_MARGIN, GATE_MARGIN = 10.0, 4.0  # 0.4 of the worst of five seeds: docs/results/clients.md


def make_envs(num_envs: int) -> VecMonitor:
    """Return environments side by side for Stable-Baselines3, with its log of returns."""
    envs = gymnasium.make_vec("flytrack_env:FlyTrack-v0", num_envs, autoreset_mode="SameStep")
    return VecMonitor(SameStepVecEnv(envs))


def make_model(seed: int, algorithm: type = PPO, **settings: Any) -> Any:
    """Return PPO, or an algorithm with the same interface, for FlyTrack-v0, not trained yet."""
    torch.set_num_threads(1)  # more threads compete with those of JAX
    return algorithm(
        "MlpPolicy",
        make_envs(256),
        n_steps=64,
        batch_size=512,
        learning_rate=1e-3,
        device="cpu",
        seed=seed,
        **(settings or {"n_epochs": 4}),
    )


def evaluate(model: Any) -> tuple[float, float]:
    """Return the mean return and gates of an episode, by Stable-Baselines3 on the same starts."""
    gates = []

    def note_gates(local_variables: dict[str, Any], _: dict[str, Any]) -> None:
        if local_variables["done"]:
            gates.append(local_variables["info"]["gates_passed"])

    envs = make_envs(NUM_FLIGHTS)
    envs.seed(EVALUATION_SEED)
    mean_return, _ = evaluate_policy(model, envs, n_eval_episodes=NUM_FLIGHTS, callback=note_gates)
    return float(mean_return), float(np.mean(gates))


def measure(seed: int, algorithm: type = PPO, **settings: Any) -> Outcome:
    """Train and return the evaluations before and after."""
    model = make_model(seed, algorithm, **settings)
    return_before, gates_before = evaluate(model)
    model.learn(1_000_000)
    return_after, gates_after = evaluate(model)
    return Outcome(return_before, return_after, gates_before, gates_after)
