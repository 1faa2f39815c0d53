"""A benchmark that others can cite: frozen tasks, policies of any origin, results as a file."""

from flytrack_env.extras import check_installed

check_installed(
    "bench", "benchmarks", "safetensors", "optax", "distrax", "scipy", "matplotlib", "tqdm"
)

from flytrack_bench.policies import Policy, PolicyError, load_policy
from flytrack_bench.results import Data, DataError, differences, run
from flytrack_bench.retrain import adapt_to_flight, diagnose_and_retrain
from flytrack_bench.suite import Suite, SuiteError, Task, load_suite

__all__ = [
    "Data",
    "DataError",
    "Policy",
    "PolicyError",
    "Suite",
    "SuiteError",
    "Task",
    "adapt_to_flight",
    "diagnose_and_retrain",
    "differences",
    "load_policy",
    "load_suite",
    "run",
]
