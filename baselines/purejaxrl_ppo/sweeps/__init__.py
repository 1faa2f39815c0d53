"""Trainings with many settings, by Ray Tune: ``python -m baselines.purejaxrl_ppo.sweeps``."""

from flytrack_env.extras import check_installed

check_installed("sweep", "sweeps", "ray")
