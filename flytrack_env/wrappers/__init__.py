"""Wrappers, each useful alone on any of the environments."""

from flytrack_env.wrappers.legacy_step import LegacyStep

__all__ = ["LegacyStep"]
