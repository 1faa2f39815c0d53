"""Every setting of a training run."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """Hyperparameters of PPO; the defaults are the recipe for FlyTrack-v0 (docs/training.md)."""

    total_timesteps: int = 12_000_000
    """Environment steps over all environments; rounded down to whole updates."""
    num_envs: int = 1024
    """Environments stepped side by side."""
    num_steps: int = 64
    """Steps of every environment per update."""
    episode_steps: int = 200
    """Time limit of training episodes. Long ones spend most experience on the one line that the policy
    flies already, and a policy that knows nothing beside it fails on another plant."""
    update_epochs: int = 4
    """Passes over the collected batch per update."""
    num_minibatches: int = 8
    """Gradient steps per pass."""
    learning_rate: float = 3e-3
    """Adam's step size at the start."""
    final_learning_rate_fraction: float = 0.02
    """The step size falls linearly to this fraction of it at the end."""
    gamma: float = 0.99
    """Discount per step."""
    gae_lambda: float = 0.95
    """Decay of the advantage estimator."""
    clip_eps: float = 0.2
    """Clipping range of the probability ratio and of the value change."""
    entropy_coef: float = 0.0
    """Weight of the entropy bonus."""
    value_coef: float = 0.5
    """Weight of the value loss."""
    max_grad_norm: float = 1.0
    """Global norm to which gradients are clipped."""
    hidden_sizes: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers, tanh, of actor and critic each."""
    initial_std: float = 0.5
    """Standard deviation of the actions at the start; it does not depend on the state."""
    min_std: float = 0.05
    """Floor of that standard deviation."""
    initial_action: tuple[float, ...] = (0.0, 0.0, 0.0, -0.2)
    """Mean action of the untrained policy: sticks centred, thrust about that of hovering."""

    @property
    def batch_size(self) -> int:
        """Environment steps per update."""
        return self.num_envs * self.num_steps

    @property
    def num_updates(self) -> int:
        """Number of updates."""
        return self.total_timesteps // self.batch_size

    def check(self) -> None:
        """Raise ValueError, naming the field, for settings that cannot be trained with."""
        if self.num_updates < 1:
            raise ValueError(
                f"total_timesteps: found {self.total_timesteps}, expected at least one update of "
                f"{self.batch_size} steps (num_envs x num_steps)"
            )
        if self.batch_size % self.num_minibatches:
            raise ValueError(
                f"num_minibatches: found {self.num_minibatches}, expected a divisor of the "
                f"{self.batch_size} steps of an update"
            )
