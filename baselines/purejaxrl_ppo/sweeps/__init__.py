"""Many settings, each a training of its own, by Ray Tune: ``python -m baselines.purejaxrl_ppo.sweeps``."""

from flytrack_env.extras import check_installed

check_installed("sweep", "sweeps", "ray")
