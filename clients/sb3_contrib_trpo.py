"""sb3-contrib's TRPO on FlyTrack-v0: Stable-Baselines3's interface, through the same adapter."""

from functools import partial

from sb3_contrib import TRPO

from clients import sb3_ppo

RETURN_MARGIN, GATE_MARGIN = 10.0, 4.0  # those of Stable-Baselines3

measure = partial(sb3_ppo.measure, algorithm=TRPO, n_critic_updates=4)
