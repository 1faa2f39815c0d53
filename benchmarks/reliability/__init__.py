"""What FlyTrack withstands, measured: ``python -m benchmarks.reliability`` writes docs/results/reliability.md."""
