"""An entry of the benchmark: diagnose a plant's data, and retrain on the extended model."""

import tempfile
from pathlib import Path

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.training import train_policy
from flytrack_bench.policies import Policy, policy_of
from flytrack_bench.results import Data
from flytrack_sysid import diagnose


def diagnose_and_retrain(data: Data, policy: Policy) -> Policy:
    """Return a policy trained from scratch, by the default recipe, on a plant's extended model.

    policy: flies all the data that are left. Flights are of its own seed, that of the training is
    0.
    """
    found = diagnose(data.fly(policy, data.seconds_left))
    with tempfile.TemporaryDirectory() as folder:
        checkpoint, _ = train_policy(
            Path(folder) / "retrained", Config(), seed=0, model=found.extended
        )
    return policy_of(checkpoint, f"{policy.name}, retrained")
