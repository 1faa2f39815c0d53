"""TorchRL's PPO on FlyTrack-v0, through its own wrapper of Gymnasium's vector environments."""

import gymnasium
import torch
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper, RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from clients.flights import Outcome, outcome_of

RETURN_MARGIN, GATE_MARGIN = 0.8, 0.3
NUM_ENVS, NUM_STEPS, NUM_UPDATES, NUM_EPOCHS, MINIBATCH = 256, 64, 60, 4, 512


def measure(seed: int) -> Outcome:
    """Train and return the results of the first and of the last episodes of the training."""
    torch.set_num_threads(1)  # more threads compete with those of JAX
    torch.manual_seed(seed)
    envs = gymnasium.make_vec("flytrack_env:FlyTrack-v0", NUM_ENVS, autoreset_mode="SameStep")
    env = TransformedEnv(GymWrapper(envs), RewardSum(), auto_unwrap=True)
    env.set_seed(seed)
    mean = torch.nn.Sequential(
        MLP(29, 8, num_cells=[64, 64]), NormalParamExtractor("biased_softplus_0.4")
    )
    outputs = ["loc", "scale"]
    module = TensorDictModule(mean, ["observation"], outputs)
    actor = ProbabilisticActor(module, outputs, distribution_class=TanhNormal, return_log_prob=True)
    critic = ValueOperator(MLP(29, 1, num_cells=[64, 64]), ["observation"])
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, entropy_bonus=False)
    optimizer, size = torch.optim.Adam(loss.parameters(), 1e-3), NUM_ENVS * NUM_STEPS
    results = []
    frames = {"frames_per_batch": size, "total_frames": size * NUM_UPDATES}
    for batch in Collector(env, actor, auto_register_policy_transforms=False, **frames):
        # The infos of the step that ends an episode are in final_info: the gates are those before
        # it.
        names = ("next", "done"), ("next", "episode_reward"), "gates_passed"
        results.append([batch[name].flatten().numpy() for name in names])
        for _ in range(NUM_EPOCHS):
            advantage(batch)
            flat = batch.reshape(-1)
            for part in flat[torch.randperm(size)].split(MINIBATCH):
                found = loss(part)
                optimizer.zero_grad()
                (found["loss_objective"] + found["loss_critic"]).backward()
                optimizer.step()
    return outcome_of(*zip(*results, strict=True))
