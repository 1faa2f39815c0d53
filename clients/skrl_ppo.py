"""skrl's PPO on FlyTrack-v0, through its own wrapper of Gymnasium's vector environments."""

from typing import Any

import gymnasium
import numpy as np
import torch
from skrl.agents.torch.ppo import PPO
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

from clients.flights import Outcome, outcome_of

RETURN_MARGIN, GATE_MARGIN = 0.8, 0.3
NUM_ENVS, NUM_STEPS, NUM_UPDATES = 256, 64, 60
NETWORK = [
    {"name": "net", "input": "OBSERVATIONS", "layers": [64, 64], "activations": "tanh"},
]
SETTINGS = {
    "rollouts": NUM_STEPS,
    "learning_epochs": 4,
    "mini_batches": 32,
    "learning_rate": 1e-3,
    "value_loss_scale": 0.5,
    "value_clip": 0.0,
    "time_limit_bootstrap": True,
    "experiment": {"write_interval": 0, "checkpoint_interval": 0},
}


class Episodes(gymnasium.vector.VectorWrapper):
    """Keep of every step where an episode ended, and its return and gates."""

    def __init__(self, envs: gymnasium.vector.VectorEnv[Any, Any, Any]):
        super().__init__(envs)
        self.returns, self.steps = np.zeros(envs.num_envs), list[Any]()

    def step(self, actions: Any) -> Any:
        """Step all environments, which reset in the same step."""
        outputs = self.env.step(actions)
        _, rewards, terminated, truncated, infos = outputs
        done = terminated | truncated
        self.returns = self.returns + rewards
        gates = infos["final_info"]["gates_passed"] if done.any() else np.zeros(self.num_envs)
        self.steps.append((done, self.returns, gates))
        self.returns = np.where(done, 0.0, self.returns)
        return outputs


def measure(seed: int) -> Outcome:
    """Train and return the results of the first and of the last episodes of the training."""
    torch.set_num_threads(1)  # more threads compete with those of JAX
    set_seed(seed)
    made = gymnasium.make_vec("flytrack_env:FlyTrack-v0", NUM_ENVS, autoreset_mode="SameStep")
    episodes = Episodes(made)
    env = wrap_env(episodes, wrapper="gymnasium", verbose=False)
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
    models = {
        "policy": gaussian_model(
            **spaces, device="cpu", network=NETWORK, output="ACTIONS", initial_log_std=-1.0
        ),
        "value": deterministic_model(**spaces, device="cpu", network=NETWORK, output="ONE"),
    }
    memory = RandomMemory(memory_size=NUM_STEPS, num_envs=NUM_ENVS, device="cpu")
    agent = PPO(models=models, memory=memory, cfg=SETTINGS, device="cpu", **spaces)
    steps = {"timesteps": NUM_STEPS * NUM_UPDATES, "headless": True, "disable_progressbar": True}
    SequentialTrainer(cfg=steps, env=env, agents=agent).train()
    return outcome_of(*map(np.stack, zip(*episodes.steps, strict=True)))
