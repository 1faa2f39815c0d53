"""What FlyTrack withstands, measured: ``python -m benchmarks.reliability``."""
