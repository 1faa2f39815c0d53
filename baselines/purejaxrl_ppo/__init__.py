"""PPO as PureJaxRL defines it, in one readable file (``ppo.py``)."""

from flytrack_env.extras import check_installed

# MLflow, which takes seconds to import, is imported when a run is tracked.
check_installed(
    "train",
    "training and policies",
    "safetensors",
    "optax",
    "distrax",
    "scipy",
    "matplotlib",
    "tqdm",
    "mlflow",
)

from baselines.purejaxrl_ppo.checkpoint import Checkpoint, CheckpointError, load_checkpoint
from baselines.purejaxrl_ppo.config import Config
from baselines.purejaxrl_ppo.networks import ActorCritic, make_network
from baselines.purejaxrl_ppo.ppo import make_train

__all__ = [
    "ActorCritic",
    "Checkpoint",
    "CheckpointError",
    "Config",
    "load_checkpoint",
    "make_network",
    "make_train",
]
