"""Says what is missing where the clients are not installed."""

import importlib.util

import pytest

for _name in ("rejax", "evosax", "stable_baselines3"):
    if importlib.util.find_spec(_name) is None:
        raise pytest.UsageError(f"clients: {_name} is not installed here; run: make test-clients")
