"""The loop from diagnosis to a better policy, measured: ``python -m benchmarks.loop``."""
