"""sbx's PPO on FlyTrack-v0: Stable-Baselines3 in JAX, through the same adapter."""

from functools import partial

from sbx import PPO

from clients import sb3_ppo

RETURN_MARGIN, GATE_MARGIN = 10.0, 4.0  # those of Stable-Baselines3

measure = partial(sb3_ppo.measure, algorithm=PPO)
