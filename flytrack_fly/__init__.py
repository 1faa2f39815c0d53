"""Fly the quadcopter by keyboard or gamepad against a ghost: ``python -m flytrack_fly`` (docs/fly.md)."""
