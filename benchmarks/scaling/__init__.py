"""How cost grows, and what more devices, processes and seeds bring: ``python -m benchmarks.scaling``."""
