"""Entries of the benchmark: diagnose a plant's data, and retrain or improve a policy on it."""

import tempfile
from pathlib import Path

from baselines.purejaxrl_ppo import Config
from baselines.purejaxrl_ppo.training import train_policy
from flytrack_bench.policies import Policy, PolicyError, policy_of
from flytrack_bench.results import Data
from flytrack_loop.adapt import adapt
from flytrack_sysid import diagnose


def diagnose_and_retrain(data: Data, policy: Policy) -> Policy:
    """Return a policy trained from scratch, by the default recipe, on a plant's extended model.

    Args:
        policy: flies all the data that are left. Flights are of its own seed, that of the training
            is 0.
    """
    found = diagnose(data.fly(policy, data.seconds_left))
    with tempfile.TemporaryDirectory() as folder:
        checkpoint, _ = train_policy(
            Path(folder) / "retrained", Config(), seed=0, model=found.extended
        )
    return policy_of(checkpoint, f"{policy.name}, retrained")


def adapt_to_flight(data: Data, policy: Policy) -> Policy:
    """Return the policy that ``flytrack adapt`` makes of a plant's data.

    Args:
        policy: flies all the data that are left, and is improved.

    Raises:
        PolicyError: a policy that is no checkpoint.
    """
    if policy.checkpoint is None:
        raise PolicyError(f"policy: found {policy.name}, expected a checkpoint, to be improved")
    adapted = adapt(data.fly(policy, data.seconds_left), policy.checkpoint)
    return policy_of(adapted.checkpoint, f"{policy.name}, adapted")
