"""Fly the quadcopter by keyboard or gamepad against a ghost: ``flytrack fly`` (docs/fly.md)."""
